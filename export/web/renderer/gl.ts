/** The little of WebGL that every pass needs. */

/** A linked program, its uniforms by name. */
export class Program {
  private readonly places = new Map<string, WebGLUniformLocation | null>();

  constructor(
    private readonly gl: WebGL2RenderingContext,
    readonly program: WebGLProgram,
  ) {}

  uniform(name: string): WebGLUniformLocation | null {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name)!;
  }

  float(name: string, value: number): void {
    this.gl.uniform1f(this.uniform(name), value);
  }

  /** Bind textures to units of their own; `contours` is an array of layers. */
  textures(named: Record<string, WebGLTexture>): void {
    const { gl } = this;
    Object.entries(named).forEach(([name, bound], unit) => {
      gl.activeTexture(gl.TEXTURE0 + unit);
      gl.bindTexture(gl.TEXTURE_2D, null);
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, null);
      gl.bindTexture(name === "contours" ? gl.TEXTURE_2D_ARRAY : gl.TEXTURE_2D, bound);
      gl.uniform1i(this.uniform(name), unit);
    });
    gl.activeTexture(gl.TEXTURE0 + 15); // whatever is bound next disturbs none of these
  }
}

export function linked(gl: WebGL2RenderingContext, vertex: string, fragment: string): Program {
  const program = gl.createProgram();
  for (const [kind, source] of [
    [gl.VERTEX_SHADER, vertex],
    [gl.FRAGMENT_SHADER, fragment],
  ] as const) {
    const shader = gl.createShader(kind)!;
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
    gl.deleteShader(shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost()) {
    const shaders = gl.getAttachedShaders(program) ?? [];
    const said = shaders.map((shader) => gl.getShaderInfoLog(shader)).join(" ");
    throw new Error(`a shader was refused: ${gl.getProgramInfoLog(program)} ${said}`.trim());
  }
  return new Program(gl, program);
}

/** A texture that is read texel by texel. */
export function texture(gl: WebGL2RenderingContext, kind: GLenum = gl.TEXTURE_2D): WebGLTexture {
  const handle = gl.createTexture();
  gl.bindTexture(kind, handle);
  gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_S, gl.CLAMP_TO_EDGE);
  gl.texParameteri(kind, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
  return handle;
}

/** The values that were used last, a few of them; others are freed. */
export class Recent<K, V> {
  private readonly values = new Map<K, V>();

  constructor(
    private readonly capacity: number,
    private readonly free: (value: V) => void,
  ) {}

  get(key: K, make: () => V): V {
    const value = this.values.get(key) ?? make();
    this.values.delete(key);
    this.values.set(key, value);
    for (const [oldest, entry] of this.values) {
      if (this.values.size <= this.capacity) break;
      this.values.delete(oldest);
      this.free(entry);
    }
    return value;
  }
}
