/** The panels at the right side or, on a phone, a sheet at the bottom with a handle that closes it. */

import { byId, h, setText } from "./dom";

export class Panel {
    private readonly element = byId("panel");
    private readonly sections = new Map<string, { section: HTMLDetailsElement; count: HTMLElement }>();
    onToggle: (isOpen: boolean) => void = () => {};

    constructor() {
        const handle = h("button", {
            className: "handle",
            title: "Close the panels",
            aria: { label: "Close the panels" },
        });
        handle.onclick = () => (this.isOpen = false);
        this.element.append(handle);
    }

    add(title: string, body: HTMLElement, isOpen: boolean): void {
        const count = h("span", { className: "count" });
        const section = h("details", { open: isOpen }, h("summary", {}, title, count), body);
        this.sections.set(title, { section, count });
        this.element.append(section);
    }

    setCount(title: string, text: string): void {
        const entry = this.sections.get(title);
        if (entry) setText(entry.count, text);
    }

    setVisible(title: string, isVisible: boolean): void {
        const entry = this.sections.get(title);
        if (entry) entry.section.hidden = !isVisible;
    }

    /** Opens the panel and one of its sections. */
    reveal(title: string): void {
        this.isOpen = true;
        const section = this.sections.get(title)?.section;
        if (!section) return;
        section.open = true;
        section.scrollIntoView({ block: "nearest" });
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
