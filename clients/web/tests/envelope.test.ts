import assert from "node:assert/strict";
import { test } from "node:test";
import { BinaryWriter } from "@bufbuild/protobuf/wire";
import { Call } from "../src/wire/call";
import {
    CLIENT_CREDIT,
    ClientKind,
    decodeCredit,
    decodeEnvelope,
    encodeCredit,
    encodeEnvelope,
    encodeStart,
    SERVER_CREDIT,
} from "../src/wire/envelope";
import { decodeStatus, RpcError } from "../src/wire/rpc_error";

interface Sent {
    kind: number;
    payload: Uint8Array;
}

function recordingCall(window?: number): { call: Call; sent: Sent[] } {
    const sent: Sent[] = [];
    const send = (kind: number, payload: Uint8Array = new Uint8Array()) => sent.push({ kind, payload });
    return { call: new Call(send, () => {}, window), sent };
}

test("envelope has the layout of proto/websocket.md", () => {
    const bytes = encodeEnvelope(0x01020304, ClientKind.message, new Uint8Array([9, 8]));
    assert.deepEqual([...bytes], [4, 3, 2, 1, 1, 9, 8]);
    assert.deepEqual(decodeEnvelope(bytes), { call: 0x01020304, kind: 1, payload: new Uint8Array([9, 8]) });
    assert.throws(() => decodeEnvelope(bytes.subarray(0, 4)), /expected at least 5 bytes, got 4/);
});

test("start has the timeout and the path", () => {
    const bytes = encodeStart("/modalcast.v1.SceneService/OpenScene", 1500);
    assert.deepEqual([...bytes.subarray(0, 4)], [0xdc, 5, 0, 0]);
    assert.equal(new TextDecoder().decode(bytes.subarray(4)), "/modalcast.v1.SceneService/OpenScene");
    assert.equal(decodeCredit(encodeCredit(4_000_000_000)), 4_000_000_000);
    assert.throws(() => decodeCredit(new Uint8Array(3)), /expected 4 bytes, got 3/);
});

test("a sender waits until its messages have credit, or until the call ends", async () => {
    const { call } = recordingCall();
    assert.equal(await call.drained(), true);
    const send = () => {
        call.send(new Uint8Array(CLIENT_CREDIT));
        call.send(new Uint8Array(1));
    };
    send();
    const drained = call.drained();
    let isDrained = false;
    void drained.then(() => (isDrained = true));
    await new Promise((done) => setTimeout(done, 1));
    assert.equal(isDrained, false);
    call.onCredit(1);
    assert.equal(await drained, true);
    send();
    const ended = call.drained();
    call.finish(null);
    assert.equal(await ended, false);
});

test("messages wait for credit, and END follows them", () => {
    const { call, sent } = recordingCall();
    call.send(new Uint8Array(CLIENT_CREDIT - 1));
    call.send(new Uint8Array(100));
    call.send(new Uint8Array(7));
    call.end();
    // The second message makes the credit negative; the third one waits.
    assert.deepEqual(
        sent.map(({ kind, payload }) => [kind, payload.length]),
        [
            [1, CLIENT_CREDIT - 1],
            [1, 100],
        ],
    );
    assert.equal(call.backlog, 1);
    call.onCredit(99);
    assert.equal(call.backlog, 1, "expected no message at a credit of 0");
    call.onCredit(1);
    assert.deepEqual(
        sent.slice(2).map(({ kind, payload }) => [kind, payload.length]),
        [
            [1, 7],
            [2, 0],
        ],
    );
});

test("credit is returned after a message was processed", async () => {
    const { call, sent } = recordingCall();
    const half = SERVER_CREDIT / 2;
    call.onMessage(new Uint8Array(half));
    call.onMessage(new Uint8Array(3));
    assert.equal((await call.next())?.length, half);
    assert.deepEqual(sent, [], "expected no credit before the next message is requested");
    await call.next();
    assert.deepEqual(sent, [{ kind: ClientKind.credit, payload: encodeCredit(half) }]);
});

test("a window of one byte allows one message at a time", async () => {
    const { call, sent } = recordingCall(1);
    let credit = SERVER_CREDIT;
    const messages = [1_000_000, 3_200_000, 50_000, 50_000];
    const deliver = () => {
        while (sent.length > 0) credit += decodeCredit(sent.shift()?.payload ?? new Uint8Array(4));
        let delivered = 0;
        while (credit > 0 && messages.length > 0) {
            const size = messages.shift() ?? 0;
            credit -= size;
            delivered++;
            call.onMessage(new Uint8Array(size));
        }
        return delivered;
    };
    // The initial credit of the protocol admits two messages; the difference to the window is withheld once.
    assert.equal(deliver(), 2);
    await call.next();
    assert.equal(deliver(), 0, "expected no credit for the first message");
    await call.next();
    const third = call.next();
    assert.equal(deliver(), 1);
    assert.equal((await third)?.length, 50_000);
    assert.equal(deliver(), 0, "expected no credit while a message is processed");
    const fourth = call.next();
    assert.equal(deliver(), 1);
    assert.equal((await fourth)?.length, 50_000);
});

test("received messages are read before the error of the call", async () => {
    const { call } = recordingCall();
    call.onMessage(new Uint8Array([1]));
    call.finish(new RpcError(14, "gone"));
    assert.deepEqual(await call.next(), new Uint8Array([1]));
    await assert.rejects(call.next(), /gone/);
});

test("cancel ends the call at both sides", async () => {
    const { call, sent } = recordingCall();
    const next = call.next();
    call.cancel();
    call.cancel();
    assert.deepEqual(
        sent.map(({ kind }) => kind),
        [ClientKind.cancel],
    );
    await assert.rejects(next, /cancelled/);
});

test("status has reason and metadata of its details", () => {
    const entry = new BinaryWriter().uint32(10).string("limit").uint32(18).string("32").finish();
    const info = new BinaryWriter()
        .uint32(10)
        .string("REASON_LIMIT_REACHED")
        .uint32(18)
        .string("modalcast")
        .uint32(26)
        .bytes(entry)
        .finish();
    const other = new BinaryWriter()
        .uint32(10)
        .string("type.googleapis.com/google.rpc.RetryInfo")
        .uint32(18)
        .bytes(new Uint8Array([1]))
        .finish();
    const detail = new BinaryWriter()
        .uint32(10)
        .string("type.googleapis.com/google.rpc.ErrorInfo")
        .uint32(18)
        .bytes(info)
        .finish();
    const status = new BinaryWriter()
        .uint32(8)
        .int32(8)
        .uint32(18)
        .string("too many")
        .uint32(26)
        .bytes(other)
        .uint32(26)
        .bytes(detail)
        .finish();
    const error = decodeStatus(status);
    assert.ok(error);
    assert.deepEqual([error.code, error.message, error.reason], [8, "too many", "REASON_LIMIT_REACHED"]);
    assert.equal(error.metadata.get("limit"), "32");
    assert.equal(decodeStatus(new Uint8Array()), null);
});
