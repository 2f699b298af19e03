import tables from "../../../../kcgs/codec/labels/prior2.bin?url&inline";
import { unpack } from "../inline.ts";
import type { LabelModel } from "./pixels.ts";

let model: LabelModel | undefined;

/** The label model of files of label maps. */
export const labelModelOfFiles = (): LabelModel => (model ??= { tables: unpack(tables), units: [96, 32] });
