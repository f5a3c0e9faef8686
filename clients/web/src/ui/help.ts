/** The overlay that lists keys and gestures. */

import { byId, h } from "./dom";

const MOUSE: [string, string][] = [
    ["Drag", "orbit"],
    ["Right drag", "pan"],
    ["Wheel, pinch", "zoom towards the pointer"],
    ["Shift + drag", "pull on the surface"],
    ["Two fingers", "pan and zoom"],
];

/** Keys and their effects. Spaces separate the keys of an entry. */
export const KEYS: [string, string][] = [
    ["Space", "play or pause"],
    [".", "show one more step"],
    ["P", "pull with the plain mouse button or a finger"],
    ["F", "frame the scene"],
    ["C", "copy the camera as Python"],
    ["V", "switch between this browser and the server's pictures"],
    ["I", "save a picture of the view as PNG"],
    ["R", "start a video of the view, or end and save it"],
    ["M", "next color map"],
    ["E", "mesh edges"],
    ["S", "shadows"],
    ["B", "show or hide the panels"],
    ["← →", "previous or next step of a recording"],
    ["?", "this help"],
];

export class Help {
    private readonly dialog = byId<HTMLDialogElement>("help");

    constructor() {
        const list = (entries: [string, string][]) =>
            h(
                "dl",
                {},
                ...entries.flatMap(([key, text]) => [
                    h("dt", {}, h("kbd", { textContent: key })),
                    h("dd", { textContent: text }),
                ]),
            );
        const close = h("button", { className: "primary", textContent: "Close" });
        close.onclick = () => this.dialog.close();
        this.dialog.append(
            h("h2", { textContent: "Mouse and touch" }),
            list(MOUSE),
            h("h2", { textContent: "Keys" }),
            list(KEYS),
            close,
        );
        this.dialog.onclick = (event) => {
            if (event.target === this.dialog) this.dialog.close();
        };
    }

    toggle(): void {
        if (this.dialog.open) this.dialog.close();
        else this.dialog.showModal();
    }
}
