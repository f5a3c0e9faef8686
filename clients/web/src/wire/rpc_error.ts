/** Errors of calls, decoded from `google.rpc.Status`. */

import { BinaryReader, WireType } from "@bufbuild/protobuf/wire";

/** Status codes of gRPC that the viewer distinguishes. */
export const StatusCode = {
    ok: 0,
    cancelled: 1,
    unknown: 2,
    notFound: 5,
    unimplemented: 12,
    unavailable: 14,
    unauthenticated: 16,
} as const;

const ERROR_INFO = "type.googleapis.com/google.rpc.ErrorInfo";

/** A call that ended with an error. */
export class RpcError extends Error {
    override readonly name = "RpcError";

    constructor(
        readonly code: number,
        message: string,
        /** Name of a `modalcast.v1.Reason`; empty if the status has no details. */
        readonly reason: string = "",
        /** "expected", "given", and the keys that `errors.proto` documents. */
        readonly metadata: ReadonlyMap<string, string> = new Map(),
    ) {
        super(message);
    }
}

type Fields = (number: number, reader: BinaryReader, wireType: WireType) => boolean;

/** Calls `field` for each field of a message, and skips those for which it returns false. */
function readFields(bytes: Uint8Array, field: Fields): void {
    const reader = new BinaryReader(bytes);
    while (reader.pos < reader.len) {
        const [number, wireType] = reader.tag();
        if (!field(number, reader, wireType)) reader.skip(wireType, number);
    }
}

interface ErrorInfo {
    reason: string;
    metadata: Map<string, string>;
}

function decodeErrorInfo(bytes: Uint8Array): ErrorInfo {
    const info: ErrorInfo = { reason: "", metadata: new Map() };
    readFields(bytes, (number, reader) => {
        if (number === 1) info.reason = reader.string();
        else if (number === 3) {
            const entry = ["", ""];
            readFields(reader.bytes(), (part, entryReader) => {
                if (part !== 1 && part !== 2) return false;
                entry[part - 1] = entryReader.string();
                return true;
            });
            info.metadata.set(entry[0] ?? "", entry[1] ?? "");
        } else return false;
        return true;
    });
    return info;
}

/** Decodes the status with which a call ends. Null if the call succeeded. */
export function decodeStatus(bytes: Uint8Array): RpcError | null {
    let code: number = StatusCode.ok;
    let message = "";
    let info: ErrorInfo = { reason: "", metadata: new Map() };
    readFields(bytes, (number, reader, wireType) => {
        if (number === 1 && wireType === WireType.Varint) code = reader.int32();
        else if (number === 2) message = reader.string();
        else if (number === 3) {
            let type = "";
            let value: Uint8Array = new Uint8Array();
            readFields(reader.bytes(), (part, detail) => {
                if (part === 1) type = detail.string();
                else if (part === 2) value = detail.bytes();
                else return false;
                return true;
            });
            if (type === ERROR_INFO) info = decodeErrorInfo(value);
        } else return false;
        return true;
    });
    return code === StatusCode.ok ? null : new RpcError(code, message, info.reason, info.metadata);
}
