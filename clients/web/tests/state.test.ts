import assert from "node:assert/strict";
import { test } from "node:test";
import { create } from "@bufbuild/protobuf";
import { StateChunkSchema, StateContent, type StateHead, StateHeadSchema } from "../src/proto/modalcast/v1/states_pb";
import { applyToPoint } from "../src/scene/affine";
import { SceneState, StateAssembler, StateLayout } from "../src/scene/state";
import { floats, fourDomains, translation } from "./scene";

interface Encoded {
    head: StateHead;
    data: Uint8Array;
}

function encode(sections: [StateContent, Uint8Array][], complete = false): Encoded {
    let offset = 0n;
    const parts = sections.map(([content, bytes]) => {
        const part = { content, offset, bytes: BigInt(bytes.length) };
        offset += part.bytes;
        return part;
    });
    const data = new Uint8Array(sections.flatMap(([, bytes]) => [...bytes]));
    return {
        head: create(StateHeadSchema, {
            sections: parts,
            total: offset,
            complete,
            step: { run: 1n, number: 5n, time: 0.5 },
        }),
        data,
    };
}

const indices = (...values: number[]) => new Uint8Array(new Uint32Array(values).buffer);
const doubles = (...values: number[]) => new Uint8Array(new Float64Array(values).buffer);

function complete(): Encoded {
    return encode(
        [
            [StateContent.Q_DOMAINS, indices(0, 1)],
            [StateContent.Q, floats(1, 2, 3)],
            [StateContent.TRANSFORM_DOMAINS, indices(0, 3)],
            [StateContent.TRANSFORMS, floats(...translation(10, 0, 0), ...translation(0, 0, 7))],
            [StateContent.ORIGINS, doubles(100, 0, 0)],
        ],
        true,
    );
}

function at(state: SceneState, domain: number): number[] {
    return applyToPoint(state.transforms, 12 * domain, [1, 0, 0]);
}

test("the rest state has the placements and rest_q of the description", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    assert.deepEqual([...state.qOf(0)], [0.5, 0]);
    assert.deepEqual(
        [at(state, 0), at(state, 3)],
        [
            [2, 2, 3],
            [1, 0, 9],
        ],
    );
});

test("followers and domains that share q have the values of others", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    const { head, data } = complete();
    state.apply(head, data);
    assert.deepEqual(
        [0, 1, 2, 3].map((domain) => [...state.qOf(domain)]),
        [[1, 2], [3], [1, 2], []],
    );
    // 1 is one unit above 0, and 2 is also turned: its x axis points up.
    assert.deepEqual(
        [0, 1, 2, 3].map((domain) => at(state, domain)),
        [
            [11, 0, 0],
            [11, 1, 0],
            [10, 2, 0],
            [1, 0, 7],
        ],
    );
    assert.equal(state.step?.number, 5n);
});

test("lists that are left out have all domains", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    const { head, data } = encode([
        [StateContent.Q, floats(4, 5, 6)],
        [StateContent.TRANSFORMS, floats(...translation(20, 0, 0), ...translation(0, 0, 8))],
    ]);
    state.apply(head, data);
    assert.deepEqual(
        [0, 1, 2, 3].map((domain) => [...state.qOf(domain)]),
        [[4, 5], [6], [4, 5], []],
    );
    assert.deepEqual([...state.rootTransforms.subarray(3, 4), ...state.rootTransforms.subarray(47, 48)], [20, 8]);
});

test("a partial state keeps the values of other domains", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    const first = complete();
    state.apply(first.head, first.data);
    const second = encode([
        [StateContent.Q_DOMAINS, indices(1)],
        [StateContent.Q, floats(-4)],
    ]);
    state.apply(second.head, second.data);
    assert.deepEqual(
        [0, 1, 2].map((domain) => [...state.qOf(domain)]),
        [[1, 2], [-4], [1, 2]],
    );
    assert.deepEqual(at(state, 0), [11, 0, 0]);
});

test("origins move the transforms of roots and of their followers in f64", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    const first = complete();
    state.apply(first.head, first.data);
    // Two roots, 0 and 3. The unit is 0.5 m, and the scene's origin is at x = 100 m.
    const far = 100 + 2 ** 40;
    const moved = encode([[StateContent.ORIGINS, doubles(far, 0, 0, 100, 0, -1)]]);
    state.apply(moved.head, moved.data);
    assert.deepEqual(
        [0, 1, 3].map((domain) => at(state, domain)),
        [
            [2 ** 41 + 11, 0, 0],
            [2 ** 41 + 11, 1, 0],
            [1, 0, 5],
        ],
    );
});

test("states that do not fit the scene are rejected", () => {
    const state = new SceneState(new StateLayout(fourDomains()));
    const reject = (sections: [StateContent, Uint8Array][], message: RegExp) => {
        const { head, data } = encode(sections);
        assert.throws(() => state.apply(head, data), message);
    };
    reject(
        [
            [StateContent.Q_DOMAINS, indices(4)],
            [StateContent.Q, floats(1)],
        ],
        /expected a domain below 4, got 4/,
    );
    reject(
        [
            [StateContent.Q_DOMAINS, indices(0)],
            [StateContent.Q, floats(1)],
        ],
        /expected 2 coordinates, got 1/,
    );
    reject(
        [
            [StateContent.TRANSFORM_DOMAINS, indices(0)],
            [StateContent.TRANSFORMS, floats(1)],
        ],
        /expected 12 numbers/,
    );
    reject([[StateContent.ORIGINS, doubles(1)]], /expected 3 or 6 numbers/);
});

test("chunks of a state are joined in order", () => {
    const { head, data } = complete();
    const assembler = new StateAssembler();
    const chunk = (from: number, to: number, first: boolean) =>
        create(StateChunkSchema, { ...(first ? { head } : {}), offset: BigInt(from), data: data.subarray(from, to) });
    assert.equal(assembler.add(chunk(0, 10, true)), null);
    assert.throws(() => assembler.add(chunk(20, 30, false)), /expected a chunk at 10, got 20/);
    assert.deepEqual(assembler.add(chunk(10, data.length, false))?.data, data);
    assert.deepEqual(assembler.add(chunk(0, data.length, true))?.data, data);
    assert.equal(assembler.add(create(StateChunkSchema, { head: create(StateHeadSchema, {}) }))?.data.length, 0);
    assert.throws(() => assembler.add(chunk(0, 1, false)), /expected a head/);
});
