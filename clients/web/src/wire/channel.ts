/** gRPC calls over one WebSocket. */

import {
    create,
    type DescMessage,
    type DescMethodBiDiStreaming,
    type DescMethodClientStreaming,
    type DescMethodServerStreaming,
    type DescMethodUnary,
    fromBinary,
    type MessageInitShape,
    type MessageShape,
    toBinary,
} from "@bufbuild/protobuf";
import { Call } from "./call";
import { ClientKind, decodeCredit, decodeEnvelope, encodeEnvelope, encodeStart, ServerKind } from "./envelope";
import { decodeStatus, RpcError, StatusCode } from "./rpc_error";

const SUBPROTOCOL = "modalcast.v1";

export interface CallOptions {
    /** Milliseconds after which the server ends the call; unset: no limit. */
    timeoutMs?: number;
    /** See `Call`. */
    window?: number;
}

/** Replies of a stream, which the client can cancel. */
export interface ReplyStream<T> extends AsyncIterable<T> {
    cancel(): void;
}

/** A call in which the client sends several messages: client streaming or bidirectional. */
export interface DuplexStream<I, O> extends ReplyStream<O> {
    send(message: I): void;
    /** Number of messages that wait for flow control. */
    readonly backlog: number;
    /** Resolves when no message waits for credit, with false if the call has ended and accepts no more messages. */
    drained(): Promise<boolean>;
    end(): void;
}

/** An open connection. */
export class Channel {
    private readonly calls = new Map<number, Call>();
    private nextCall = 1;
    /** Why the server has closed the connection; 0 while it is open. */
    closeCode = 0;
    bytesReceived = 0;
    bytesSent = 0;

    private constructor(private readonly socket: WebSocket) {
        socket.addEventListener("message", (event) => this.onMessage(event));
        socket.addEventListener("close", (event) => {
            this.closeCode = event.code;
            this.fail();
        });
    }

    /**
     * Opens a connection. Rejects if the server cannot be reached or refuses the connection.
     *
     * @param session Token of the session whose rights the calls have; null: none.
     */
    static open(url: string, session: string | null = null): Promise<Channel> {
        return new Promise((resolve, reject) => {
            const socket = new WebSocket(url, SUBPROTOCOL);
            socket.binaryType = "arraybuffer";
            const start = () => {
                const channel = new Channel(socket);
                if (session) channel.send(0, ClientKind.session, new TextEncoder().encode(session));
                resolve(channel);
            };
            socket.addEventListener("open", start, { once: true });
            socket.addEventListener("error", () => reject(unavailable()), { once: true });
        });
    }

    /** Resolves when the connection has ended. */
    get closed(): Promise<void> {
        if (this.socket.readyState === WebSocket.CLOSED) return Promise.resolve();
        return new Promise((resolve) => this.socket.addEventListener("close", () => resolve(), { once: true }));
    }

    get isOpen(): boolean {
        return this.socket.readyState === WebSocket.OPEN;
    }

    close(): void {
        this.socket.close();
    }

    async unary<I extends DescMessage, O extends DescMessage>(
        method: DescMethodUnary<I, O>,
        request: MessageInitShape<I>,
        options: CallOptions = {},
    ): Promise<MessageShape<O>> {
        const call = this.startWith(method, request, options);
        const reply = await call.next();
        if (!reply) throw new RpcError(StatusCode.unknown, "the call has ended without a reply");
        // The status follows the reply.
        await call.next();
        return fromBinary(method.output, reply);
    }

    serverStream<I extends DescMessage, O extends DescMessage>(
        method: DescMethodServerStreaming<I, O>,
        request: MessageInitShape<I>,
        options: CallOptions = {},
    ): ReplyStream<MessageShape<O>> {
        const call = this.startWith(method, request, options);
        return { [Symbol.asyncIterator]: () => replies(call, method.output), cancel: () => call.cancel() };
    }

    duplexStream<I extends DescMessage, O extends DescMessage>(
        method: DescMethodBiDiStreaming<I, O> | DescMethodClientStreaming<I, O>,
        options: CallOptions = {},
    ): DuplexStream<MessageInitShape<I>, MessageShape<O>> {
        const call = this.start(method, options);
        return {
            [Symbol.asyncIterator]: () => replies(call, method.output),
            cancel: () => call.cancel(),
            send: (message) => call.send(toBinary(method.input, create(method.input, message))),
            get backlog() {
                return call.backlog;
            },
            drained: () => call.drained(),
            end: () => call.end(),
        };
    }

    private startWith<I extends DescMessage>(
        method: { input: I; name: string; parent: { typeName: string } },
        request: MessageInitShape<I>,
        options: CallOptions,
    ): Call {
        const call = this.start(method, options);
        call.send(toBinary(method.input, create(method.input, request)));
        call.end();
        return call;
    }

    private start(method: { name: string; parent: { typeName: string } }, options: CallOptions): Call {
        const id = this.nextCall++;
        const send = (kind: number, payload?: Uint8Array) => this.send(id, kind, payload);
        const call = new Call(send, () => this.calls.delete(id), options.window);
        this.calls.set(id, call);
        send(ClientKind.start, encodeStart(`/${method.parent.typeName}/${method.name}`, options.timeoutMs ?? 0));
        if (!this.isOpen) call.finish(unavailable());
        return call;
    }

    private send(call: number, kind: number, payload?: Uint8Array): void {
        if (!this.isOpen) return;
        const bytes = encodeEnvelope(call, kind, payload);
        this.bytesSent += bytes.length;
        this.socket.send(bytes as Uint8Array<ArrayBuffer>);
    }

    private onMessage(event: MessageEvent): void {
        if (!(event.data instanceof ArrayBuffer)) return;
        this.bytesReceived += event.data.byteLength;
        const { call: id, kind, payload } = decodeEnvelope(new Uint8Array(event.data));
        // Messages of a call can arrive after the client has cancelled it.
        const call = this.calls.get(id);
        if (!call) return;
        if (kind === ServerKind.message) call.onMessage(payload);
        else if (kind === ServerKind.credit) call.onCredit(decodeCredit(payload));
        else if (kind === ServerKind.status) call.finish(decodeStatus(payload));
    }

    private fail(): void {
        for (const call of [...this.calls.values()]) call.finish(unavailable());
    }
}

async function* replies<O extends DescMessage>(call: Call, schema: O): AsyncGenerator<MessageShape<O>> {
    try {
        for (let bytes = await call.next(); bytes; bytes = await call.next()) yield fromBinary(schema, bytes);
    } finally {
        call.cancel();
    }
}

function unavailable(): RpcError {
    return new RpcError(StatusCode.unavailable, "no connection to the server");
}
