/** Arrays and textures by SHA-256 in IndexedDB, so that the browser loads each content only once. */

import { toHex } from "../scene/numbers";

/** Largest sum of all stored contents in bytes. Above it, the contents that were not used for the longest time go. */
const CACHE_BYTES = 512 << 20;
const STORE = "contents";

interface Entry {
    hash: string;
    bytes: Uint8Array<ArrayBuffer>;
    /** Milliseconds since the epoch. */
    used: number;
}

export class ContentCache {
    private constructor(private readonly database: IDBDatabase | null) {}

    /** Opens the cache. Without IndexedDB, for example in a private window, the cache stays empty. */
    static async open(): Promise<ContentCache> {
        try {
            const request = indexedDB.open("modalcast", 1);
            request.onupgradeneeded = () => request.result.createObjectStore(STORE, { keyPath: "hash" });
            return new ContentCache(await finished(request));
        } catch {
            return new ContentCache(null);
        }
    }

    async read(hash: string): Promise<Uint8Array | null> {
        if (!this.database) return null;
        try {
            const store = this.database.transaction(STORE, "readwrite").objectStore(STORE);
            const entry: Entry | undefined = await finished(store.get(hash));
            if (!entry) return null;
            store.put({ ...entry, used: Date.now() });
            return entry.bytes;
        } catch {
            return null;
        }
    }

    /** Stores contents. A full disk is no error: the contents are then loaded again. */
    async write(contents: ReadonlyMap<string, Uint8Array>): Promise<void> {
        if (!this.database || contents.size === 0) return;
        try {
            const transaction = this.database.transaction(STORE, "readwrite");
            const store = transaction.objectStore(STORE);
            for (const [hash, bytes] of contents) {
                store.put({ hash, bytes: bytes.slice(), used: Date.now() } satisfies Entry);
            }
            await this.evict(store);
        } catch {
            // See above.
        }
    }

    private async evict(store: IDBObjectStore): Promise<void> {
        const entries: { hash: string; bytes: number; used: number }[] = [];
        await new Promise<void>((resolve, reject) => {
            const request = store.openCursor();
            request.onerror = () => reject(request.error);
            request.onsuccess = () => {
                const cursor = request.result;
                if (!cursor) return resolve();
                const { hash, bytes, used } = cursor.value as Entry;
                entries.push({ hash, bytes: bytes.length, used });
                cursor.continue();
            };
        });
        let total = entries.reduce((sum, entry) => sum + entry.bytes, 0);
        for (const entry of entries.sort((a, b) => a.used - b.used)) {
            if (total <= CACHE_BYTES) break;
            store.delete(entry.hash);
            total -= entry.bytes;
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
