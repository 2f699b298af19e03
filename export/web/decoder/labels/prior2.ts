import tables from "../../../../kcgs/codec/labels/prior2.bin?url&inline";
import { unpack } from "../inline.ts";
import { Network } from "./network.ts";

let network: Network | undefined;

/** The label model of files of label maps. */
export const labelModelOfFiles = (): Network => (network ??= new Network(unpack(tables), [96, 32]));
