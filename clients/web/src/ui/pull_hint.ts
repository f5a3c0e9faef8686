/** A message on how to pull, until this browser has pulled once. */

import type { Notices } from "./notices";

const TOPIC = "pull-hint";
const STORAGE_KEY = "modalcast.has-pulled";

/** Whether fingers or a small page need the tool, because there is no Shift. */
export function isPhone(): boolean {
    return window.innerWidth <= 720 || window.matchMedia("(hover: none)").matches;
}

/** The gesture, in one line. */
export function pullHintText(needsTool: boolean): string {
    return needsTool ? "To pull: tap the arrow below, then drag." : "Shift + drag pulls on the model.";
}

export class PullHint {
    private isOver = hasPulled();
    private isShown = false;

    constructor(private readonly notices: Notices) {}

    /** Shows the message when a pull has an effect, and hides it when it has none. */
    update(hasEffect: boolean): void {
        if (this.isOver || hasEffect === this.isShown) return;
        this.isShown = hasEffect;
        this.notices.show(TOPIC, hasEffect ? pullHintText(isPhone()) : "", { duration: 0 });
    }

    /** The user has pulled. */
    end(): void {
        if (this.isOver) return;
        this.isOver = true;
        this.notices.hide(TOPIC);
        try {
            localStorage.setItem(STORAGE_KEY, "1");
        } catch {
            // Without storage, the next page shows the message again.
        }
    }
}

function hasPulled(): boolean {
    try {
        return localStorage.getItem(STORAGE_KEY) !== null;
    } catch {
        return false;
    }
}
