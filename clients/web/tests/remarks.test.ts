/** The remarks on the files of a scene, and the message on them. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { remarkNotice, remarkTexts } from "../src/ui/remarks";

const SIZE =
    "the scene is 80 x 60 x 70 m; if its file is in millimeters, pass --unit mm, or set unit = 'mm' in scene.toml";
const info = (...remarks: string[]) => ({ remarks, source: "./bracket.stl", unit: 1 });

test("the message is the only remark or the number of remarks", () => {
    const missing = "material library 'a.mtl' does not exist";
    const texts = [info(), info(missing), info(SIZE, missing)].map(remarkNotice);
    assert.deepEqual(texts, ["", missing, "2 notes on the files of this scene."]);
});

test("a remark on the size names the whole command", () => {
    assert.deepEqual(remarkTexts(info(SIZE)), [
        "The model is 80 x 60 x 70 m large. If its file is in millimeters: `modalcast view bracket.stl --unit mm`",
    ]);
    const small =
        "the scene is 1e-5 x 1e-5 x 1e-5 m; if its file is not in meters, pass --unit, or set `unit` in scene.toml";
    assert.match(remarkTexts(info(small))[0] ?? "", /`modalcast view bracket.stl --unit UNIT`, where UNIT is mm/);
});
