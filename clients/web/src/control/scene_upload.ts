/** Uploads dropped files to the server as one scene. */

import type { SceneInfo } from "../proto/modalcast/v1/scenes_pb";
import type { Limits } from "../proto/modalcast/v1/server_pb";
import type { Server, UploadedFile } from "../source/server";
import * as format from "../ui/format";

/** Model files, which give a scene of several files its name. The server decides which file it opens. */
const MODEL = /\.(glb|gltf|obj|ply|stl|npz)$/i;
const MAX_NAME_LETTERS = 64;
/** Largest number of files of an upload, see UploadHeader. */
const MAX_FILES = 4096;

/** Why the files cannot be uploaded; empty if they can. */
export function uploadProblem(files: readonly UploadedFile[], limits: Pick<Limits, "uploadBytes"> | undefined): string {
    if (files.length === 0) return "There are no files in this folder.";
    if (files.length > MAX_FILES)
        return `The server accepts at most ${format.count(MAX_FILES)} files for a scene, and these are ${format.count(files.length)}.`;
    const total = files.reduce((sum, { file }) => sum + file.size, 0);
    if (limits && BigInt(total) > limits.uploadBytes) {
        const limit = format.bytes(Number(limits.uploadBytes));
        return `The server accepts at most ${limit} for a scene, and these files have ${format.bytes(total)}.`;
    }
    if (!globalThis.crypto?.subtle)
        return "The browser cannot compute the checksums of an upload on this page, because it was loaded from another machine without encryption. Open it over HTTPS, or through `ssh -L`, so that its address begins with localhost.";
    return "";
}

/** The path to open: the only file, or the whole folder, in which the server finds scene.toml or the model. */
export function entryOf(files: readonly UploadedFile[]): string {
    return files.length === 1 ? (files[0]?.path ?? "") : "";
}

/**
 * The files and a scene.toml that sets the unit of their model to millimeters. Null if the files contain a scene.toml,
 * or not exactly one model.
 */
export function inMillimeters(files: readonly UploadedFile[]): UploadedFile[] | null {
    const [model, ...others] = files.filter(({ path }) => MODEL.test(path));
    if (!model || others.length > 0 || files.some(({ path }) => /(^|\/)scene\.toml$/.test(path))) return null;
    // A JSON string is also a TOML string.
    const text = `model = ${JSON.stringify(model.path)}\nunit = "mm"\n`;
    return [...files, { path: "scene.toml", file: new Blob([text]) }];
}

/**
 * Whether a remark of the server says that the model may be in millimeters: it has no unit, and is very large in
 * meters.
 */
export function mayBeInMillimeters({ remarks }: Pick<SceneInfo, "remarks">): boolean {
    return remarks.some((remark) => remark.includes("if its file is in millimeters"));
}

/** A scene name for the files that no other scene has. */
export function sceneName(files: readonly UploadedFile[], used: ReadonlySet<string>): string {
    const { path } = files.find((candidate) => MODEL.test(candidate.path)) ?? files[0] ?? { path: "" };
    const stem = path.replace(/^.*\//, "").replace(/\.[^.]*$/, "");
    const valid = stem.replace(/[^A-Za-z0-9._-]+/g, "-").replace(/^[.-]+/, "") || "model";
    for (let number = 1; ; number++) {
        const suffix = number === 1 ? "" : `-${number}`;
        const name = valid.slice(0, MAX_NAME_LETTERS - suffix.length) + suffix;
        if (!used.has(name)) return name;
    }
}

/**
 * Uploads the files, and opens them as a scene.
 *
 * @param progress Called with the number of bytes sent so far, and the number of bytes of all files.
 * @throws Error with a sentence for the user.
 */
export async function uploadScene(
    server: Server,
    files: readonly UploadedFile[],
    progress: (sent: number, total: number) => void,
): Promise<SceneInfo> {
    const { limits } = await server.getInfo();
    const problem = uploadProblem(files, limits);
    if (problem) throw new Error(problem);
    const { scenes, opening, failed } = await server.listScenes();
    const used = [...scenes.map(({ scene }) => scene), ...opening, ...failed.map(({ scene }) => scene)];
    const total = files.reduce((sum, { file }) => sum + file.size, 0);
    let sent = 0;
    progress(0, total);
    return server.uploadScene(sceneName(files, new Set(used)), entryOf(files), files, (bytes) => {
        sent += bytes;
        progress(sent, total);
    });
}
