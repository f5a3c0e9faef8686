/** The message on the remarks of a scene. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { remarkNotice } from "../src/ui/remarks";

test("the message is a short remark or the number of remarks", () => {
    const size = "the scene is 18 x 128 x 6 m; if its file is in millimeters, pass --unit mm";
    const texts = [[], [size], ["x".repeat(141)], [size, "material library 'a.mtl' does not exist"]].map(remarkNotice);
    const expected = ["", size, "1 note on the files of this scene.", "2 notes on the files of this scene."];
    assert.deepEqual(texts, expected);
});
