/** What renderers make of a scene once, kept beside its label map as long as that stays. */

import type { RegionMap, Scene } from "../decoder/scene.ts";
import { gaussiansOf } from "./gaussians.ts";
import { membershipOf, uniform } from "./membership.ts";
import type { Contours, Membership } from "./membership.ts";
import type { Prepared } from "./software.ts";

const CHANNELS = [1, 3, 4];
const memberships = new WeakMap<Int32Array, Map<string, Membership>>();

export function prepare(scene: Scene, contours: Contours): Prepared {
  const { width, height, channels, regions } = scene;
  if (!CHANNELS.includes(channels)) {
    throw new Error(`an image of 1, 3 or 4 channels can be shown; this scene has ${channels}.`);
  }
  const membership = regions === null ? uniform() : find(regions, width, contours);
  return { width, height, gaussians: gaussiansOf(scene), membership };
}

function find(regions: RegionMap, width: number, contours: Contours): Membership {
  const ofMap = memberships.get(regions.labels) ?? new Map<string, Membership>();
  memberships.set(regions.labels, ofMap);
  const membership = ofMap.get(contours) ?? membershipOf(regions, width, contours);
  ofMap.set(contours, membership);
  return membership;
}
