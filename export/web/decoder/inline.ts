/** The bytes of a file that the build has put into the bundle, as a data URL. */
export function unpack(url: string): Uint8Array {
  return Uint8Array.from(atob(url.slice(url.indexOf(",") + 1)), (byte) => byte.charCodeAt(0));
}
