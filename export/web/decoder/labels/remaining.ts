/** Which of so many things in order are left: a tree of counts, so that millions take seconds. */
export class Remaining {
  private readonly tree: Int32Array;

  constructor(count: number) {
    this.tree = new Int32Array(count + 1).map((_, i) => i & -i);
  }

  /** Remove the one that so many are left before; return its place. */
  take(rank: number): number {
    const { tree } = this;
    let place = 0;
    for (let step = 2 ** Math.floor(Math.log2(tree.length)); step >= 1; step /= 2) {
      if (place + step >= tree.length) continue;
      if (tree[place + step]! <= rank) {
        place += step;
        rank -= tree[place]!;
      } else tree[place + step]! -= 1;
    }
    return place;
  }
}
