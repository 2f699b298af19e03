/** What renderers make of a scene once, kept beside its label map as long as that stays. */

import type { RegionMap, Scene } from "../decoder/scene.ts";
import { gaussiansOf } from "./gaussians.ts";
import type { Gaussians } from "./gaussians.ts";
import { membershipOf, uniform } from "./membership.ts";
import type { Membership } from "./membership.ts";
import { isNative } from "./sampling.ts";
import type { View } from "./sampling.ts";
import type { Prepared } from "./software.ts";

const CHANNELS = [1, 3, 4];
const memberships = new WeakMap<Int32Array, Map<boolean, Membership>>();

/** A scene, and its tables for views at its own size, smaller ones, or larger ones: made when first asked for. */
export class PreparedScene {
  readonly width: number;
  readonly height: number;
  private readonly gaussians: Gaussians;
  private readonly regions: RegionMap | null;
  private readonly tables = new Map<boolean, Prepared>();

  constructor(scene: Scene) {
    if (!CHANNELS.includes(scene.channels)) {
      throw new Error(`an image of 1, 3 or 4 channels can be shown; this scene has ${scene.channels}.`);
    }
    ({ width: this.width, height: this.height, regions: this.regions } = scene);
    this.gaussians = gaussiansOf(scene);
  }

  at(view: View): Prepared {
    const { width, height, gaussians, regions } = this;
    const smooth = regions !== null && regions.ids.length > 1 && !isNative(view);
    return lazily(this.tables, smooth, () => {
      const membership = regions === null ? uniform() : find(regions, width, smooth);
      return { width, height, gaussians, membership };
    });
  }
}

function find(regions: RegionMap, width: number, smooth: boolean): Membership {
  const ofMap = memberships.get(regions.labels) ?? new Map<boolean, Membership>();
  memberships.set(regions.labels, ofMap);
  return lazily(ofMap, smooth, () => membershipOf(regions, width, smooth));
}

function lazily<K, V>(values: Map<K, V>, key: K, make: () => V): V {
  let value = values.get(key);
  if (value === undefined) values.set(key, (value = make()));
  return value;
}
