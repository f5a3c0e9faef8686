/** Names and limits of uploads. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { entryOf, inMillimeters, sceneName, uploadProblem } from "../src/control/scene_upload";
import type { UploadedFile } from "../src/source/server";

function files(...paths: string[]): UploadedFile[] {
    return paths.map((path) => ({ path, file: new Blob(["12345"]) }));
}

test("a scene has the name of its model, with valid letters only", () => {
    const name = (...paths: string[]) => sceneName(files(...paths), new Set());
    assert.equal(name("bracket.stl"), "bracket");
    assert.equal(name("wood.png", "parts/My chair (2).OBJ", "chair.mtl"), "My-chair-2-");
    assert.equal(name("scene.toml"), "scene");
    assert.equal(name(".hidden.obj"), "hidden");
    assert.equal(name("\u7a93.stl"), "model");
    assert.equal(name(`${"a".repeat(80)}.stl`).length, 64);
});

test("a name that is in use gets a number", () => {
    assert.equal(sceneName(files("a.stl"), new Set(["a", "a-2"])), "a-3");
    const long = "b".repeat(64);
    assert.equal(sceneName(files(`${long}.stl`), new Set([long])), `${"b".repeat(62)}-2`);
});

test("a single file is opened itself, and several as a folder", () => {
    assert.equal(entryOf(files("part.stl")), "part.stl");
    assert.equal(entryOf(files("part.obj", "part.mtl")), "");
});

test("files beyond the limits of the server are not sent", () => {
    assert.equal(uploadProblem(files("a.obj", "a.mtl"), { uploadBytes: 10n }), "");
    assert.equal(
        uploadProblem(files("a.obj", "a.mtl"), { uploadBytes: 9n }),
        "The server accepts at most 9 B for a scene, and these files have 10 B.",
    );
    assert.match(uploadProblem([], undefined), /no files/);
    assert.match(uploadProblem(Array(4097).fill(files("a")[0]), undefined), /at most 4,096 files/);
});

test("a scene.toml sets the unit of the only model", async () => {
    const millimeters = inMillimeters(files("wood.png", 'parts/5" pipe.obj'));
    assert.equal(entryOf(millimeters ?? []), "");
    assert.deepEqual(
        millimeters?.map(({ path }) => path),
        ["wood.png", 'parts/5" pipe.obj', "scene.toml"],
    );
    assert.equal(await millimeters?.at(-1)?.file.text(), 'model = "parts/5\\" pipe.obj"\nunit = "mm"\n');
    assert.equal(inMillimeters(files("a.stl", "scene.toml")), null);
    assert.equal(inMillimeters(files("a.stl", "b.stl")), null);
});
