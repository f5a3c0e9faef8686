/** Why a scene does not react to a pull, and the command that changes this, in words for the user. */

import type { SceneInfo } from "../proto/modalcast/v1/scenes_pb";
import { rankOf, type SceneDescription } from "../scene/description";
import { mayBeInMillimeters } from "./scene_upload";

const MODEL_FILE = /[^/\\]+\.(glb|gltf|obj|ply|stl|npz|structure\.json)$/i;

/** The command that opens the model of a scene with further options. */
export function viewCommand(info: Pick<SceneInfo, "source" | "unit" | "remarks">, options: string): string {
    const file = MODEL_FILE.exec(info.source)?.[0] ?? "part.stl";
    const unit = info.unit === 0.001 || mayBeInMillimeters(info) ? " --unit mm" : "";
    return `modalcast view ${file.includes(" ") ? `'${file}'` : file}${unit}${options && ` ${options}`}`;
}

/**
 * The problem of a scene without modes or without eigenvalues; empty if its modes have eigenvalues, or if it has the
 * cubic forces of Vega.
 */
export function missingModes(scene: SceneDescription): string {
    const { info, domains, shapes } = scene;
    const command = viewCommand(info, "--modes 20");
    if (domains.every((domain) => rankOf(scene, domain) === 0))
        return `This model is rigid, because it has no vibration modes. To bend it, compute them: \`${command}\``;
    const hasStiffness =
        domains.some(({ eigenvalues, notes }) => eigenvalues !== undefined || "vega.cubic" in notes) ||
        shapes.some(({ eigenvalues }) => eigenvalues.length > 0);
    if (hasStiffness) return "";
    return `The modes of this model have no stiffness, so it does not react to a pull. Add the array \`eigenvalues\` in (rad/s)² to its file, or compute new modes: \`${command}\``;
}

/**
 * Why nothing reacts to a pull.
 *
 * @param receiverError See StreamForcesResponse.receiver_error.
 * @param server URL of the server.
 */
export function pullProblem(scene: SceneDescription, receiverError: string, server: string): string {
    const missing = missingModes(scene);
    if (missing) return missing;
    const command = `modalcast-sim ${scene.info.scene} --server ${server} --slow auto --forces --seconds 0 --realtime`;
    const start = `start physics in a second terminal: \`${command}\``;
    if (receiverError)
        return `A pull has no effect, because the physics process has ended: ${receiverError}. To continue, ${start}`;
    return `A pull has no effect, because no physics is running. Leave out \`--no-sim\`, or ${start}`;
}
