/**
 * The session of this page: the rights that the server gives to its calls. A link to the page has a code that is valid
 * once. The page exchanges it for the token of a session, which lasts as long as the tab.
 */

/** Close code of a WebSocket whose session the server does not know. */
export const UNKNOWN_SESSION_CODE = 4003;

/** What has become of the code in the address. */
export type CodeResult = "none" | "accepted" | "rejected";

/** For browsers that do not let the page store anything. */
let unstored: string | null = null;

/** The URL of a resource of this server. The page may be in a folder of a proxy. */
export function urlBesidePage(name: string): URL {
    const url = new URL(location.href);
    url.pathname = `${location.pathname.replace(/\/+$/, "")}/${name}`;
    url.search = "";
    url.hash = "";
    return url;
}

/** Several servers can have one host and port behind a proxy, each with its own path. */
function storageKey(): string {
    return `modalcast-session ${location.pathname}`;
}

export function sessionToken(): string | null {
    try {
        return sessionStorage.getItem(storageKey()) ?? unstored;
    } catch {
        return unstored;
    }
}

function storeSession(token: string | null): void {
    unstored = token;
    try {
        if (token) sessionStorage.setItem(storageKey(), token);
        else sessionStorage.removeItem(storageKey());
    } catch {
        // The session lasts until the page is loaded again.
    }
}

export function forgetSession(): void {
    storeSession(null);
}

export function hasCode(): boolean {
    return new URLSearchParams(location.hash.slice(1)).has("code");
}

/**
 * Exchanges the code in the address, if there is one, for a session, and removes it from the address and the history of the
 * browser. Rejects if the server cannot be reached.
 */
export async function redeemCode(): Promise<CodeResult> {
    const parameters = new URLSearchParams(location.hash.slice(1));
    const code = parameters.get("code");
    if (code === null) return "none";
    const response = await fetch(urlBesidePage("session"), { method: "POST", body: code, cache: "no-store" });
    parameters.delete("code");
    const rest = parameters.toString();
    history.replaceState(history.state, "", `${location.pathname}${location.search}${rest ? `#${rest}` : ""}`);
    if (!response.ok) return "rejected";
    storeSession(await response.text());
    return "accepted";
}
