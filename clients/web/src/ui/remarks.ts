/** Remarks of the loader on the files of a scene: a section of the panel, and a message when the scene is shown. */

import { h } from "./dom";
import type { Notices } from "./notices";
import type { Panel } from "./panel";

const TITLE = "Notes on files";
const TOPIC = "remarks";
/** Milliseconds until the message disappears. */
const NOTICE_MS = 12_000;
/** Largest number of letters of a remark in the message, so that it covers little of the view. */
const MAX_NOTICE_LETTERS = 140;

/** The message on remarks: a short remark itself, or the number of remarks. Empty without remarks. */
export function remarkNotice(remarks: readonly string[]): string {
    const [first] = remarks;
    if (first === undefined) return "";
    if (remarks.length > 1) return `${remarks.length} notes on the files of this scene.`;
    return first.length <= MAX_NOTICE_LETTERS ? first : "1 note on the files of this scene.";
}

export class RemarksSection {
    private readonly list = h("ul", { className: "remarks" });

    constructor(
        private readonly panel: Panel,
        private readonly notices: Notices,
    ) {
        panel.add(TITLE, h("div", { className: "body" }, this.list), false);
        panel.setVisible(TITLE, false);
    }

    /** Shows the remarks of a scene; an empty list hides the section and the message. */
    set(remarks: readonly string[]): void {
        this.list.replaceChildren(...remarks.map((remark) => h("li", { textContent: remark })));
        this.panel.setVisible(TITLE, remarks.length > 0);
        this.panel.setCount(TITLE, String(remarks.length));
        this.notices.show(TOPIC, remarkNotice(remarks), {
            severity: "warn",
            duration: NOTICE_MS,
            action: { label: "Show", run: () => this.reveal() },
        });
    }

    private reveal(): void {
        this.panel.reveal(TITLE);
        this.notices.hide(TOPIC);
    }
}
