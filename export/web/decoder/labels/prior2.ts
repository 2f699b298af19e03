import tables from "../../../../kcgs/codec/labels/prior2.bin?packed";
import { unpack } from "../packed_text.ts";
import type { LabelModel } from "./pixels.ts";

let model: LabelModel | undefined;

/** The label model of files of label maps. */
export const labelModelOfFiles = (): LabelModel => (model ??= { tables: unpack(tables), units: [96, 32] });
