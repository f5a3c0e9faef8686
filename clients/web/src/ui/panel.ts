/** The panels at the right side, or at the bottom of a phone. */

import { byId, h, setText } from "./dom";

export class Panel {
    private readonly element = byId("panel");
    private readonly counts = new Map<string, HTMLElement>();
    onToggle: (isOpen: boolean) => void = () => {};

    add(title: string, body: HTMLElement, isOpen: boolean): void {
        const count = h("span", { className: "count" });
        this.counts.set(title, count);
        this.element.append(h("details", { open: isOpen }, h("summary", {}, title, count), body));
    }

    setCount(title: string, text: string): void {
        const count = this.counts.get(title);
        if (count) setText(count, text);
    }

    get isOpen(): boolean {
        return !this.element.classList.contains("collapsed");
    }

    set isOpen(isOpen: boolean) {
        this.element.classList.toggle("collapsed", !isOpen);
        document.body.classList.toggle("wide", !isOpen);
        this.onToggle(isOpen);
    }
}
