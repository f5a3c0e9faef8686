import assert from "node:assert/strict";
import { test } from "node:test";
import { create, toBinary } from "@bufbuild/protobuf";
import { StreamForcesResponseSchema } from "../src/proto/modalcast/v1/forces_pb";
import { StateContent } from "../src/proto/modalcast/v1/states_pb";
import { ArrayKind, type SceneDescription } from "../src/scene/description";
import { SceneModel } from "../src/scene/scene_model";
import { lastIndexAt, Playback } from "../src/source/playback";
import { decodeBase64, readRecording } from "../src/source/recording";
import { Contents, type RecordedMessage, sceneMessages, stateMessage, writeRecording } from "./recording_file";
import { floats, fourDomains } from "./scene";

/** The scene with arrays of hashes, and the contents in the order of the hashes. */
function sceneWithContents(): { scene: SceneDescription; contents: Contents } {
    const scene = fourDomains();
    const contents = new Contents();
    for (const shape of scene.shapes) {
        const numbers = new Uint8Array(new Uint32Array([0, 1, 2]).buffer);
        const positions = floats(...Array.from({ length: 9 }, (_, i) => shape.shape + i));
        const modes = floats(...Array.from({ length: 9 * shape.rank }, (_, i) => i / 10));
        shape.arrays = contents.add([
            [ArrayKind.INDICES, numbers],
            [ArrayKind.CORNER_VERTICES, numbers],
            [ArrayKind.REST_POSITIONS, positions],
            [ArrayKind.REST_NORMALS, positions],
            [ArrayKind.MODES, modes],
        ]);
    }
    return { scene, contents };
}

/** A state with q of domain 0 or, if it is complete, of all domains. */
function state(number: number, time: number, q: number[], complete: boolean): RecordedMessage {
    const domains = complete ? [0, 1] : [0];
    const sections: [StateContent, Uint8Array][] = [
        [StateContent.Q_DOMAINS, new Uint8Array(new Uint32Array(domains).buffer)],
        [StateContent.Q, floats(...q, ...(complete ? [number] : []))],
    ];
    return stateMessage(number, time, sections, complete);
}

/** Ten states, one every 0.5 s, of which every fourth is complete. q0 of domain 0 is the index of the state. */
async function recording(contentsMode = "embedded"): Promise<Uint8Array> {
    const { scene, contents } = sceneWithContents();
    const messages = sceneMessages(scene, contents);
    for (let index = 0; index < 10; index++) messages.push(state(index, index / 2, [index, -index], index % 4 === 0));
    const forces = create(StreamForcesResponseSchema, { forces: [{ owner: 3n }] });
    messages.push({ topic: "forces", time: 3, data: toBinary(StreamForcesResponseSchema, forces) });
    return writeRecording(messages, {
        recording: { version: "1", contents: contentsMode },
        content: { sha256: contents.sha256 },
        view: { eye: "1 2 3", target: "0 0 0.5", field_of_view: "28", width: "1280", height: "720" },
    });
}

test("a recording has scene, arrays, states, forces and view", async () => {
    const { scene, arrays, states, forces, view, isCutOff } = readRecording(await recording());
    assert.equal(scene.domains.length, 4);
    assert.deepEqual([...(arrays.shapes[1]?.restPositions ?? [])], [1, 2, 3, 4, 5, 6, 7, 8, 9]);
    assert.equal(arrays.shapes[2]?.modes, null);
    assert.deepEqual(
        states.map(({ time }) => time),
        [0, 0.5, 1, 1.5, 2, 2.5, 3, 3.5, 4, 4.5],
    );
    assert.deepEqual(states.map(({ isComplete }) => isComplete).slice(0, 5), [true, false, false, false, true]);
    assert.deepEqual([forces.length, isCutOff], [1, false]);
    assert.deepEqual(view, { eye: [1, 2, 3], target: [0, 0, 0.5], fieldOfView: 28, aspect: 16 / 9 });
});

test("a sought time shows the state that playing to this time shows", async () => {
    const file = readRecording(await recording());
    const model = new SceneModel(file.scene, file.arrays);
    const playback = new Playback(file, model);
    const shown = (time: number) => {
        playback.seek(time);
        return [model.state.step?.number, model.state.q[0], model.state.qOf(1)[0]];
    };
    assert.equal(playback.duration, 4.5);
    // q of domain 1 is that of the last complete state.
    assert.deepEqual(shown(0), [0n, 0, 0]);
    assert.deepEqual(shown(3.4), [6n, 6, 4]);
    assert.deepEqual(shown(0.7), [1n, 1, 0], "expected a state before the shown one");
    assert.deepEqual(shown(99), [9n, 9, 8]);
    assert.deepEqual(shown(-1), [0n, 0, 0]);
});

test("forces appear at their time, and disappear before it", async () => {
    const file = readRecording(await recording());
    const model = new SceneModel(file.scene, file.arrays);
    const playback = new Playback(file, model);
    playback.seek(2.5);
    assert.equal(model.forces.length, 0);
    playback.seek(3);
    assert.equal(model.forces.length, 1);
    playback.seek(1);
    assert.equal(model.forces.length, 0);
});

test("a file that was cut off plays up to its end", async () => {
    const file = await recording();
    const { states, isCutOff } = readRecording(file.subarray(0, file.length - 700));
    assert.ok(isCutOff && states.length > 0, `${states.length} states`);
});

test("other files are rejected with the reason", async () => {
    assert.throws(() => readRecording(new TextEncoder().encode("no recording, but a text of some length")));
    const byHash = await recording("by-hash");
    assert.throws(() => readRecording(byHash), /by hash/);
    const other = await writeRecording([], { recording: { version: "2" } });
    assert.throws(() => readRecording(other), /expected format version 1, got 2/);
});

test("finds the last entry at a time, and decodes base64", () => {
    const entries = [{ time: 0 }, { time: 1 }, { time: 1 }, { time: 4 }];
    assert.deepEqual(
        [-1, 0, 0.9, 1, 3, 9].map((time) => lastIndexAt(entries, time)),
        [0, 0, 0, 2, 2, 3],
    );
    assert.deepEqual(decodeBase64(" AP+A\n"), new Uint8Array([0, 255, 128]));
});
