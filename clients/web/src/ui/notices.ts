/** Messages in a corner of the view, one per topic. Each has one line until the user opens it. */

import { byId, h, setMarkedText } from "./dom";
import { icon } from "./icons";

export type Severity = "info" | "warn" | "bad";

export interface NoticeOptions {
    severity?: Severity;
    /** Milliseconds until the message disappears; 0: it stays. */
    duration?: number;
    action?: { label: string; run: () => void };
}

interface Shown {
    element: HTMLElement;
    text: string;
    timer: ReturnType<typeof setTimeout> | null;
}

export class Notices {
    private readonly container = byId("notices");
    private readonly shown = new Map<string, Shown>();

    /**
     * Shows a message in place of the previous one of the same topic. An empty text removes it. Backticks enclose
     * commands.
     */
    show(topic: string, text: string, { severity = "info", duration = 6000, action }: NoticeOptions = {}): void {
        const previous = this.shown.get(topic);
        if (previous && previous.text === text) {
            if (previous.timer !== null) clearTimeout(previous.timer);
            previous.timer = isOpen(previous.element) ? null : this.timer(topic, duration);
            return;
        }
        this.hide(topic);
        if (!text) return;
        const close = h(
            "button",
            { className: "icon", title: "Close", aria: { label: "Close this message" } },
            icon("close"),
        );
        close.onclick = () => this.hide(topic);
        const run = action && h("button", { className: "outline", textContent: action.label });
        if (run && action) run.onclick = () => action.run();
        const line = h("p");
        setMarkedText(line, text);
        const more = h("button", { className: "more", textContent: "More", aria: { expanded: "false" } });
        more.onclick = () => this.toggle(topic);
        const element = h("div", { className: `notice card ${severity}` }, line, more, run, close);
        this.container.append(element);
        // The line can be opened if it does not fit.
        more.hidden = line.scrollWidth <= line.clientWidth;
        this.shown.set(topic, { element, text, timer: this.timer(topic, duration) });
    }

    /** Opens or closes a message. An opened message stays until the user closes it. */
    private toggle(topic: string): void {
        const notice = this.shown.get(topic);
        const more = notice?.element.querySelector(".more");
        if (!notice || !more) return;
        const opens = notice.element.classList.toggle("open");
        more.setAttribute("aria-expanded", String(opens));
        more.textContent = opens ? "Less" : "More";
        if (notice.timer !== null) clearTimeout(notice.timer);
        notice.timer = null;
    }

    private timer(topic: string, duration: number): ReturnType<typeof setTimeout> | null {
        return duration > 0 ? setTimeout(() => this.hide(topic), duration) : null;
    }

    hide(topic: string): void {
        const notice = this.shown.get(topic);
        if (!notice) return;
        if (notice.timer !== null) clearTimeout(notice.timer);
        notice.element.remove();
        this.shown.delete(topic);
    }
}

function isOpen(element: HTMLElement): boolean {
    return element.classList.contains("open");
}
