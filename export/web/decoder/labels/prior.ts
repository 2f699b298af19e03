import tables from "../../../../kcgs/codec/labels/prior.bin?packed";
import { unpack } from "../packed_text.ts";
import type { LabelModel } from "./pixels.ts";

let model: LabelModel | undefined;

/** The label model of scenes. */
export const labelModel = (): LabelModel => (model ??= { tables: unpack(tables), units: [48, 16] });
