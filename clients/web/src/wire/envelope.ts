/** Messages of the WebSocket envelope, see `proto/websocket.md`: call id (u32), kind (u8), payload; little-endian. */

/** Kinds of messages from the client. */
export const ClientKind = { start: 0, message: 1, end: 2, cancel: 3, credit: 4, session: 6 } as const;
/** Kinds of messages from the server. */
export const ServerKind = { message: 1, credit: 4, status: 5 } as const;

export const HEADER_BYTES = 5;
/** Bytes of messages that the server may send on a call before the client returns credit. */
export const SERVER_CREDIT = 4 << 20;
/** Bytes of messages that the client may send on a call before the server returns credit. */
export const CLIENT_CREDIT = 1 << 20;

export interface Envelope {
    call: number;
    kind: number;
    payload: Uint8Array;
}

export function encodeEnvelope(call: number, kind: number, payload: Uint8Array = new Uint8Array()): Uint8Array {
    const bytes = new Uint8Array(HEADER_BYTES + payload.length);
    new DataView(bytes.buffer).setUint32(0, call, true);
    bytes[4] = kind;
    bytes.set(payload, HEADER_BYTES);
    return bytes;
}

/** The payload is a view into `bytes`. Throws if the header is incomplete. */
export function decodeEnvelope(bytes: Uint8Array): Envelope {
    if (bytes.length < HEADER_BYTES) {
        throw new Error(`WebSocket message: expected at least ${HEADER_BYTES} bytes, got ${bytes.length}`);
    }
    const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.byteLength);
    return { call: view.getUint32(0, true), kind: view.getUint8(4), payload: bytes.subarray(HEADER_BYTES) };
}

/** Payload of START: the timeout in milliseconds (0: none) and the gRPC path. */
export function encodeStart(path: string, timeoutMs: number): Uint8Array {
    const text = new TextEncoder().encode(path);
    const payload = new Uint8Array(4 + text.length);
    new DataView(payload.buffer).setUint32(0, timeoutMs, true);
    payload.set(text, 4);
    return payload;
}

/** Payload of CREDIT. */
export function encodeCredit(bytes: number): Uint8Array {
    const payload = new Uint8Array(4);
    new DataView(payload.buffer).setUint32(0, bytes, true);
    return payload;
}

export function decodeCredit(payload: Uint8Array): number {
    if (payload.length !== 4) throw new Error(`CREDIT: expected 4 bytes, got ${payload.length}`);
    return new DataView(payload.buffer, payload.byteOffset, 4).getUint32(0, true);
}
