/** The picture that a decoder is compared with. */

export interface Original {
  name: string;
  bitmap: ImageBitmap;
  /** RGBA of 8 bits a channel, over white where the file is transparent. */
  pixels: Uint8ClampedArray;
}

/** Decode an image file as kcgs reads it: turned by EXIF, without colour profile, transparent parts over white. */
export async function readOriginal(blob: Blob, name: string): Promise<Original> {
  let decoded: ImageBitmap;
  try {
    decoded = await createImageBitmap(blob, { colorSpaceConversion: "none", imageOrientation: "from-image" });
  } catch {
    throw new Error("it is no image that this browser can read.");
  }
  const canvas = new OffscreenCanvas(decoded.width, decoded.height);
  const context = canvas.getContext("2d", { willReadFrequently: true })!;
  context.fillStyle = "#fff";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.drawImage(decoded, 0, 0);
  decoded.close();
  const { data } = context.getImageData(0, 0, canvas.width, canvas.height);
  return { name, bitmap: await createImageBitmap(canvas), pixels: data };
}
