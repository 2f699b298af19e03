import tables from "../../../../kcgs/codec/labels/prior.bin?url&inline";
import { unpack } from "../inline.ts";
import { Network } from "./network.ts";

let network: Network | undefined;

/** The label model of scenes. */
export const labelModel = (): Network => (network ??= new Network(unpack(tables), [48, 16]));
