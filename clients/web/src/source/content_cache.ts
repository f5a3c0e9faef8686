/** Arrays and textures by SHA-256 in IndexedDB, so that the browser loads each content only once. */

import { toHex } from "../scene/numbers";

/** Limit on the stored contents in bytes. Above it, the least recently used contents are removed. */
const CACHE_BYTES = 512 << 20;
/** Object stores, by hash: the contents; their sizes and times of use, which are read without the contents. */
const CONTENTS = "contents";
const USES = "uses";

interface Use {
    hash: string;
    bytes: number;
    /** Milliseconds since the epoch. */
    used: number;
}

export class ContentCache {
    private constructor(private readonly database: IDBDatabase | null) {}

    /** Opens the cache. Without IndexedDB, for example in a private window, the cache stays empty. */
    static async open(): Promise<ContentCache> {
        try {
            const request = indexedDB.open("modalcast", 1);
            request.onupgradeneeded = () => {
                request.result.createObjectStore(CONTENTS);
                request.result.createObjectStore(USES, { keyPath: "hash" });
            };
            return new ContentCache(await finished(request));
        } catch {
            return new ContentCache(null);
        }
    }

    /** The stored contents among those with the given hashes. One transaction, because a plant has thousands. */
    async read(hashes: readonly string[]): Promise<Map<string, Uint8Array>> {
        const found = new Map<string, Uint8Array>();
        if (!this.database) return found;
        try {
            const transaction = this.database.transaction([CONTENTS, USES], "readwrite");
            const [contents, uses] = [transaction.objectStore(CONTENTS), transaction.objectStore(USES)];
            const read = async (hash: string) => {
                const bytes: Uint8Array | undefined = await finished(contents.get(hash));
                if (!bytes) return;
                found.set(hash, bytes);
                uses.put({ hash, bytes: bytes.length, used: Date.now() } satisfies Use);
            };
            await Promise.all(hashes.map(read));
        } catch {
            // The contents are then loaded from the server.
        }
        return found;
    }

    /** Stores contents. A full disk is no error: the contents are then loaded again. */
    async write(received: ReadonlyMap<string, Uint8Array>): Promise<void> {
        if (!this.database || received.size === 0) return;
        try {
            const transaction = this.database.transaction([CONTENTS, USES], "readwrite");
            const [contents, uses] = [transaction.objectStore(CONTENTS), transaction.objectStore(USES)];
            for (const [hash, bytes] of received) {
                contents.put(bytes, hash);
                uses.put({ hash, bytes: bytes.length, used: Date.now() } satisfies Use);
            }
            const all: Use[] = await finished(uses.getAll());
            let total = all.reduce((sum, use) => sum + use.bytes, 0);
            for (const use of all.sort((a, b) => a.used - b.used)) {
                if (total <= CACHE_BYTES) break;
                contents.delete(use.hash);
                uses.delete(use.hash);
                total -= use.bytes;
            }
        } catch {
            // A full disk: the contents are then loaded again.
        }
    }
}

function finished<T>(request: IDBRequest<T>): Promise<T> {
    return new Promise((resolve, reject) => {
        request.onsuccess = () => resolve(request.result);
        request.onerror = () => reject(request.error);
    });
}

/**
 * Whether bytes have a hash. True if the browser cannot tell: pages without TLS have no SHA-256 except on the loopback
 * address.
 */
export async function hasHash(bytes: Uint8Array, hash: string): Promise<boolean> {
    if (!globalThis.crypto?.subtle) return true;
    return toHex(new Uint8Array(await crypto.subtle.digest("SHA-256", bytes as Uint8Array<ArrayBuffer>))) === hash;
}
