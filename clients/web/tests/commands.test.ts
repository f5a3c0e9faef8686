import assert from "node:assert/strict";
import { test } from "node:test";
import { type CommandHandlers, keyCommands } from "../src/ui/commands";
import { KEYS } from "../src/ui/help";

/** `KeyboardEvent.key` of the keys whose names in the help differ. */
const EVENT_KEYS: Record<string, string> = { Space: " ", "←": "ArrowLeft", "→": "ArrowRight" };

/** What each key of the help calls. */
const CALLS: Record<string, string> = {
    " ": "togglePause()",
    ".": "step(1)",
    p: "togglePull()",
    f: "frameScene()",
    c: "copyCamera()",
    v: "togglePictures()",
    i: "savePicture()",
    r: "toggleVideo()",
    m: "nextColor()",
    e: "toggleEdges()",
    s: "toggleShadows()",
    b: "togglePanel()",
    ArrowLeft: "stepRecording(-1)",
    ArrowRight: "stepRecording(1)",
    "?": "toggleHelp()",
};

test("the help lists exactly the keys that have commands", () => {
    const calls: string[] = [];
    const handlers = new Proxy({} as CommandHandlers, {
        get:
            (_, name) =>
            (...parameters: unknown[]) =>
                calls.push(`${String(name)}(${parameters.join()})`),
    });
    const commands = keyCommands(handlers);
    const helped = KEYS.flatMap(([keys]) => keys.split(" ")).map((key) => EVENT_KEYS[key] ?? key.toLowerCase());
    assert.deepEqual(helped.toSorted(), Object.keys(commands).toSorted());
    for (const key of helped) {
        calls.length = 0;
        commands[key]?.();
        assert.deepEqual(calls, [CALLS[key]], `key ${key}`);
    }
});
