/** The renderer on a GPU, by WebGL2: one context for all scenes of a page. */

import { linked, Recent, texture } from "./gl.ts";
import type { Program } from "./gl.ts";
import { fineAxis, placed } from "./sampling.ts";
import type { Axis, FineAxis, View } from "./sampling.ts";
import { contourShader, FULLSCREEN, showShader, SPLAT_VERTEX, splatShader } from "./shaders.ts";
import type { Prepared } from "./software.ts";
import { uploadGaussians, uploadMembership } from "./upload.ts";
import type { GaussianBuffer, MapTextures } from "./upload.ts";

// pixels along a side that are rendered at once
const TILE = 2048;
const CACHED_SCENES = 8;

interface Target {
  readonly width: number;
  readonly height: number;
  readonly layers: number;
  readonly sums: WebGLTexture;
  readonly slots: WebGLTexture;
  readonly sumBuffer: WebGLFramebuffer;
  readonly slotBuffer: WebGLFramebuffer;
}

/** Of the sums of colours; float16 is off by up to a level of 255 where many Gaussians overlap. */
export type Precision = "float32" | "float16";

export class WebGl {
  readonly precision: Precision;
  private readonly programs = new Map<string, Program>();
  private readonly maps = new Recent<object, MapTextures>(CACHED_SCENES, (resource) => resource.free());
  private readonly buffers = new Recent<object, GaussianBuffer>(CACHED_SCENES, (resource) => resource.free());
  private readonly axes: [WebGLTexture, WebGLTexture];
  private target: Target | null = null;

  private constructor(
    readonly canvas: HTMLCanvasElement,
    private readonly gl: WebGL2RenderingContext,
  ) {
    const float = gl.getExtension("EXT_color_buffer_float");
    if (float === null && gl.getExtension("EXT_color_buffer_half_float") === null) {
      throw new Error("this GPU cannot add up colours: it has no floating point framebuffers.");
    }
    this.precision = float !== null && gl.getExtension("EXT_float_blend") !== null ? "float32" : "float16";
    this.axes = [texture(gl), texture(gl)];
  }

  /** Open a context; null where there is none. One that is emulated on the CPU counts only if asked for. */
  static open(emulated: boolean): WebGl | null {
    const canvas = document.createElement("canvas");
    const gl = canvas.getContext("webgl2", {
      antialias: false,
      depth: false,
      stencil: false,
      failIfMajorPerformanceCaveat: !emulated,
      powerPreference: "high-performance",
    });
    if (gl === null || (!emulated && isEmulated(gl))) return null;
    try {
      return new WebGl(canvas, gl);
    } catch {
      return null;
    }
  }

  get lost(): boolean {
    return this.gl.isContextLost();
  }

  /** Whether the tables of a scene fit into textures, and a view onto the canvas. */
  takes({ membership }: Prepared, view: View): boolean {
    return Math.max(membership.width, membership.height, view.width, view.height) <= this.limit;
  }

  /** Render into the upper left corner of `canvas`, which shows it until the task ends. */
  render(scene: Prepared, view: View, visible: Uint8Array): void {
    const { canvas, gl } = this;
    if (canvas.width < view.width) canvas.width = view.width;
    if (canvas.height < view.height) canvas.height = view.height;
    if (gl.drawingBufferWidth < canvas.width || gl.drawingBufferHeight < canvas.height) {
      throw new Error(`the GPU has no room for ${canvas.width} x ${canvas.height} pixels.`);
    }
    const map = this.maps.get(scene.membership, () => uploadMembership(gl, scene.membership, visible.length));
    const gaussians = this.buffers.get(scene, () => uploadGaussians(gl, scene, map));
    map.show(visible);
    for (const part of this.parts(scene, view)) this.renderPart(scene, part, map, gaussians, visible.includes(0));
  }

  private get limit(): number {
    return this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE) as number;
  }

  /** Cut a view into parts whose fine render is no larger than a tile. */
  private *parts(scene: Prepared, view: View): Generator<Part> {
    const [left, top, right, bottom] = view.rect;
    const [dx, dy] = [(right - left) / view.width, (bottom - top) / view.height];
    const tile = Math.min(TILE, this.limit);
    const finer = (step: number): number => (view.draft === true ? 1 : Math.max(1, step));
    const along = (step: number): number => Math.max(1, Math.floor(tile / finer(step) - 2));
    const [across, down] = [along(dx), along(dy)];
    for (let y = 0; y < view.height; y += down) {
      for (let x = 0; x < view.width; x += across) {
        const [width, height] = [Math.min(across, view.width - x), Math.min(down, view.height - y)];
        yield {
          x,
          y,
          width,
          height,
          across: fineAxis(left + x * dx, left + (x + width) * dx, width, scene.width, view.draft),
          down: fineAxis(top + y * dy, top + (y + height) * dy, height, scene.height, view.draft),
        };
      }
    }
  }

  private renderPart(scene: Prepared, part: Part, map: MapTextures, gaussians: GaussianBuffer, hides: boolean): void {
    const target = this.targetOf(part.across.count, part.down.count, map.layers);
    this.findContours(scene, part, map, target);
    this.sum(part, gaussians, target);
    this.show(scene, part, target, hides);
  }

  private findContours({ membership }: Prepared, { across, down }: Part, map: MapTextures, target: Target): void {
    const { gl } = this;
    const { width, height, variances, variance, smooth } = membership;
    const kind = `contours ${map.layers} ${variances !== null}`;
    const program = this.program(kind, FULLSCREEN, () => contourShader(map.layers, variances !== null));
    gl.useProgram(program.program);
    [placed(across, width), placed(down, height)].forEach((axis, i) => this.uploadAxis(this.axes[i]!, axis));
    program.textures({
      heads: map.heads,
      lists: map.lists,
      visible: map.visible,
      columns: this.axes[0],
      rows: this.axes[1],
      variances: map.variances,
    });
    program.float("uniformVariance", variance);
    program.float("ratio", smooth ? 1 / (across.step * down.step) : 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.slotBuffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  private sum({ across, down }: Part, gaussians: GaussianBuffer, target: Target): void {
    const { gl } = this;
    const program = this.program(`splat ${target.layers}`, SPLAT_VERTEX, () => splatShader(target.layers));
    gl.useProgram(program.program);
    program.textures({ contours: target.slots });
    const ends = [across, down].map((axis) => axis.start + axis.step * axis.count);
    gl.uniform4f(program.uniform("part"), across.start, down.start, ends[0]!, ends[1]!);
    gl.uniform2f(program.uniform("pixels"), 1 / across.step, 1 / down.step);
    gl.bindFramebuffer(gl.FRAMEBUFFER, target.sumBuffer);
    gl.viewport(0, 0, target.width, target.height);
    gl.clearBufferfv(gl.COLOR, 0, [0, 0, 0, 0]);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE);
    gl.bindVertexArray(gaussians.array);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, gaussians.count);
  }

  private show(scene: Prepared, { x, y, width, height, across, down }: Part, target: Target, hides: boolean): void {
    const { gl, canvas } = this;
    const { channels } = scene.gaussians;
    const program = this.program(`show ${target.layers} ${channels}`, FULLSCREEN, () =>
      showShader(target.layers, channels),
    );
    gl.useProgram(program.program);
    program.textures({ sums: target.sums, contours: target.slots });
    gl.uniform4f(
      program.uniform("spans"),
      across.mean?.from ?? 0,
      across.mean?.span ?? 0,
      down.mean?.from ?? 0,
      down.mean?.span ?? 0,
    );
    gl.uniform2i(program.uniform("corner"), x, canvas.height - y - height);
    gl.uniform1i(program.uniform("height"), height);
    gl.uniform1i(program.uniform("hides"), Number(hides));
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(x, canvas.height - y - height, width, height);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(null);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
  }

  private uploadAxis(into: WebGLTexture, { low, high, share }: Axis): void {
    const { gl } = this;
    const texels = new Float32Array(4 * low.length);
    for (let i = 0; i < low.length; i++) texels.set([low[i]!, high[i]!, share[i]!, 0], 4 * i);
    gl.bindTexture(gl.TEXTURE_2D, into);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, low.length, 1, 0, gl.RGBA, gl.FLOAT, texels);
  }

  private program(key: string, vertex: string, fragment: () => string): Program {
    let program = this.programs.get(key);
    if (program === undefined) this.programs.set(key, (program = linked(this.gl, vertex, fragment())));
    return program;
  }

  private targetOf(width: number, height: number, layers: number): Target {
    const { gl, target } = this;
    if (target?.width === width && target.height === height && target.layers === layers) return target;
    if (target !== null) {
      for (const resource of [target.sums, target.slots]) gl.deleteTexture(resource);
      for (const resource of [target.sumBuffer, target.slotBuffer]) gl.deleteFramebuffer(resource);
    }
    const [sums, slots] = [texture(gl), texture(gl, gl.TEXTURE_2D_ARRAY)];
    gl.bindTexture(gl.TEXTURE_2D, sums);
    gl.texStorage2D(gl.TEXTURE_2D, 1, this.precision === "float32" ? gl.RGBA32F : gl.RGBA16F, width, height);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, slots);
    gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, gl.RGBA32UI, width, height, layers);
    const [sumBuffer, slotBuffer] = [gl.createFramebuffer(), gl.createFramebuffer()];
    gl.bindFramebuffer(gl.FRAMEBUFFER, sumBuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, sums, 0);
    gl.bindFramebuffer(gl.FRAMEBUFFER, slotBuffer);
    const attachments = Array.from({ length: layers }, (_, i) => gl.COLOR_ATTACHMENT0 + i);
    attachments.forEach((point, i) => gl.framebufferTextureLayer(gl.FRAMEBUFFER, point, slots, 0, i));
    gl.drawBuffers(attachments);
    for (const buffer of [sumBuffer, slotBuffer]) {
      gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
      const whole = gl.checkFramebufferStatus(gl.FRAMEBUFFER) === gl.FRAMEBUFFER_COMPLETE;
      if (!whole && !this.lost) throw new Error(`the GPU has no room for ${width} x ${height} pixels.`);
    }
    return (this.target = { width, height, layers, sums, slots, sumBuffer, slotBuffer });
  }
}

/** Whether a GPU is a program on the CPU, which not all browsers call a performance caveat. */
function isEmulated(gl: WebGL2RenderingContext): boolean {
  const names = gl.getExtension("WEBGL_debug_renderer_info");
  const name: unknown = gl.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? gl.RENDERER);
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(String(name));
}

/** A block of the output, and the fine render that it is made of. */
interface Part {
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
  readonly across: FineAxis;
  readonly down: FineAxis;
}
