/** Between the decoder's planes of floats and pictures of 8 bits a channel. */

export interface Picture {
  /** (1, C, H, W); may go beyond [0, 1]. */
  data: Float32Array;
  dims: readonly number[];
}

/** Interleave planes (C, H, W) as RGBA: one plane is grey, three RGB, four RGBA; of other counts the first is shown. */
export function toRgba(picture: Picture): ImageData {
  const [, channels = 1, height = 1, width = 1] = picture.dims;
  const { data } = picture;
  const count = height * width;
  const image = new ImageData(width, height);
  const rgba = image.data;
  const green = channels >= 3 ? count : 0;
  const alpha = channels === 4 ? 3 * count : -1;
  for (let i = 0, o = 0; i < count; i++, o += 4) {
    // Uint8ClampedArray clips, and rounds to the nearest level.
    rgba[o] = data[i]! * 255;
    rgba[o + 1] = data[i + green]! * 255;
    rgba[o + 2] = data[i + 2 * green]! * 255;
    rgba[o + 3] = alpha < 0 ? 255 : data[i + alpha]! * 255;
  }
  return image;
}

/** PSNR in dB of a decoded picture, clipped to [0, 1], against RGBA pixels of the same size. */
export function psnr(picture: Picture, original: Uint8ClampedArray): number {
  const [, channels = 1, height = 1, width = 1] = picture.dims;
  const count = height * width;
  if (original.length !== 4 * count) throw new RangeError("psnr takes pictures of one size");
  let total = 0;
  for (let channel = 0; channel < channels; channel++) {
    for (let i = 0; i < count; i++) {
      const value = Math.min(Math.max(picture.data[channel * count + i]!, 0), 1);
      const level = channels < 3 ? luma(original, 4 * i) : original[4 * i + channel]!;
      const error = value - level / 255;
      total += error * error;
    }
  }
  return -10 * Math.log10(total / (channels * count));
}

/** Rec. 601, as kcgs reads a picture as grey. */
function luma(rgba: Uint8ClampedArray, at: number): number {
  return 0.299 * rgba[at]! + 0.587 * rgba[at + 1]! + 0.114 * rgba[at + 2]!;
}
