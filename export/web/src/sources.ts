/** Where decoders and originals come from: files, addresses of this server, bundled examples. */

export interface Example {
  name: string;
  decoder: string;
  original: string | null;
  note: string;
}

const EXAMPLES = "examples/index.json";

/** Resolve an address against the page and refuse those of other servers: the page talks to its own alone. */
export function sameOrigin(address: string, base: string = document.baseURI): URL {
  let url: URL | null = null;
  try {
    url = new URL(address, base);
  } catch {
    // Told below, with addresses that are well formed but elsewhere.
  }
  if (url === null || url.origin !== new URL(base).origin) {
    throw new Error("it must lie on the server that this page came from; save it and open the file instead.");
  }
  return url;
}

export async function fetchBlob(url: URL, cache: RequestCache = "default"): Promise<Blob> {
  let response: Response;
  try {
    response = await fetch(url, { cache });
  } catch {
    throw new Error("the server does not answer.");
  }
  if (!response.ok) throw new Error(`the server answers ${response.status} ${response.statusText}`.trim() + ".");
  return response.blob();
}

/**
 * The bundled examples, none where the list is missing or no list. Its addresses are relative to itself. Servers date
 * files to the second, so a list that was just changed would come from the cache: it is read without.
 */
export async function readExamples(): Promise<Example[]> {
  const base = new URL(EXAMPLES, document.baseURI).href;
  try {
    const list: unknown = JSON.parse(await (await fetchBlob(new URL(base), "no-store")).text());
    return Array.isArray(list) ? list.flatMap((item) => readExample(item, base)) : [];
  } catch {
    return [];
  }
}

function readExample(item: unknown, base: string): Example[] {
  const { name, decoder, original, note } = (item ?? {}) as Record<string, unknown>;
  if (typeof name !== "string" || typeof decoder !== "string") return [];
  return [
    {
      name,
      decoder: new URL(decoder, base).href,
      original: typeof original === "string" && original !== "" ? new URL(original, base).href : null,
      note: typeof note === "string" ? note : "",
    },
  ];
}

export function fileName(url: URL): string {
  return decodeURIComponent(url.pathname.split("/").at(-1) ?? "") || url.pathname;
}
