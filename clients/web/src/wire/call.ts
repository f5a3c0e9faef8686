/** One call of a channel: a queue of received messages, and the flow control in both directions. */

import { CLIENT_CREDIT, ClientKind, encodeCredit, SERVER_CREDIT } from "./envelope";
import { RpcError, StatusCode } from "./rpc_error";

/** Credit is returned in batches of at least this many bytes, or of half the call's window if that is less. */
const CREDIT_BATCH = 256 << 10;

export type SendEnvelope = (kind: number, payload?: Uint8Array) => void;

export class Call {
    private readonly received: Uint8Array[] = [];
    private wake: (() => void) | null = null;
    private error: RpcError | null = null;
    private hasEnded = false;
    private clientCredit = CLIENT_CREDIT;
    private readonly waiting: Uint8Array[] = [];
    private endsAfterWaiting = false;
    private wakeSender: (() => void) | null = null;
    private unreturned: number;
    private readonly creditBatch: number;
    private inProcess = 0;

    /**
     * @param window Bytes of unprocessed messages at which the server pauses. One message may exceed it, so 1 admits
     *     one message at a time.
     */
    constructor(
        private readonly sendEnvelope: SendEnvelope,
        private readonly release: () => void,
        window: number = SERVER_CREDIT,
    ) {
        // The server starts with SERVER_CREDIT. A smaller window reduces the first returned credit by the difference.
        this.unreturned = Math.min(window, SERVER_CREDIT) - SERVER_CREDIT;
        this.creditBatch = Math.min(CREDIT_BATCH, Math.ceil(window / 2));
    }

    /** Queues a message; it is sent when the call has credit. */
    send(message: Uint8Array): void {
        if (this.hasEnded) return;
        this.waiting.push(message);
        this.flush();
    }

    /** Number of messages that wait for credit. */
    get backlog(): number {
        return this.waiting.length;
    }

    /** Resolves when no message waits for credit, with false if the call has ended and accepts no more messages. */
    async drained(): Promise<boolean> {
        while (!this.hasEnded && this.waiting.length > 0) {
            await new Promise<void>((resolve) => {
                this.wakeSender = resolve;
            });
        }
        return !this.hasEnded;
    }

    /** No more messages follow. */
    end(): void {
        this.endsAfterWaiting = true;
        this.flush();
    }

    cancel(): void {
        if (this.hasEnded) return;
        this.sendEnvelope(ClientKind.cancel);
        this.finish(new RpcError(StatusCode.cancelled, "cancelled"));
    }

    /** The next message; null when the call has ended with OK. Throws RpcError if it ended with an error. */
    async next(): Promise<Uint8Array | null> {
        this.returnCredit(this.inProcess);
        this.inProcess = 0;
        while (this.received.length === 0) {
            if (this.error) throw this.error;
            if (this.hasEnded) return null;
            await new Promise<void>((resolve) => {
                this.wake = resolve;
            });
        }
        const message = this.received.shift() as Uint8Array;
        this.inProcess = message.length;
        return message;
    }

    onMessage(message: Uint8Array): void {
        this.received.push(message);
        this.notify();
    }

    onCredit(bytes: number): void {
        this.clientCredit += bytes;
        this.flush();
    }

    /** Ends the call. Messages that were received before can still be read. */
    finish(error: RpcError | null): void {
        if (this.hasEnded) return;
        this.hasEnded = true;
        this.error = error;
        this.waiting.length = 0;
        this.release();
        this.notify();
        this.wakeSender?.();
    }

    private notify(): void {
        this.wake?.();
        this.wake = null;
    }

    private flush(): void {
        if (this.hasEnded) return;
        while (this.waiting.length > 0 && this.clientCredit > 0) {
            const message = this.waiting.shift() as Uint8Array;
            this.clientCredit -= message.length;
            this.sendEnvelope(ClientKind.message, message);
        }
        if (this.waiting.length === 0) this.wakeSender?.();
        if (this.endsAfterWaiting && this.waiting.length === 0) {
            this.endsAfterWaiting = false;
            this.sendEnvelope(ClientKind.end);
        }
    }

    private returnCredit(bytes: number): void {
        this.unreturned += bytes;
        if (this.hasEnded || this.unreturned <= 0 || this.unreturned < this.creditBatch) return;
        this.sendEnvelope(ClientKind.credit, encodeCredit(this.unreturned));
        this.unreturned = 0;
    }
}
