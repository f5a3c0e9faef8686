/** The memory that a scene may take in this browser. */

import { meshBytes } from "./render/surfaces";
import { modeBytes, type SceneDescription } from "./scene/description";
import * as format from "./ui/format";

/** Limits in bytes: on U, stored in 16 bits per entry, and on the merged meshes. Above a limit, the server draws. */
const MODE_BUDGET = 128e6;
const MESH_BUDGET = 512e6;

/** Why a scene exceeds the budget; empty if it does not. */
export function budgetProblem(scene: SceneDescription): string {
    const modes = modeBytes(scene) / 2;
    const limit = modeBudget();
    if (modes > limit) return `The modes need ${format.bytes(modes)}, and the limit is ${format.bytes(limit)}.`;
    const meshes = meshBytes(scene);
    if (meshes <= MESH_BUDGET) return "";
    return `The meshes need ${format.bytes(meshes)}, and the limit is ${format.bytes(MESH_BUDGET)}.`;
}

/** The limit on U; `#u_budget=BYTES` in the address sets another one. */
function modeBudget(): number {
    const value = Number(new URLSearchParams(location.hash.slice(1)).get("u_budget") ?? Number.NaN);
    return value >= 0 ? value : MODE_BUDGET;
}
