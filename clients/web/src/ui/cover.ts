/** The page in front of the view: loading, choice of a scene, and errors that end the view. */

import { byId, h, setText } from "./dom";

export interface Choice {
    label: string;
    detail: string;
    run: () => void;
}

export class Cover {
    private readonly element = byId("cover");
    private progress: HTMLProgressElement | null = null;
    private readonly progressTitle = h("h1");

    hide(): void {
        this.element.hidden = true;
        this.progress = null;
    }

    showMessage(title: string, text: string, command = ""): void {
        this.set(
            h("h1", { textContent: title }),
            h("p", { textContent: text }),
            command && h("pre", { textContent: command }),
        );
    }

    showChoices(title: string, text: string, choices: Choice[]): void {
        const buttons = choices.map(({ label, detail, run }) => {
            const button = h("button", {}, h("span", { textContent: label }), h("small", { textContent: detail }));
            button.onclick = run;
            return button;
        });
        this.set(
            h("h1", { textContent: title }),
            h("p", { textContent: text }),
            h("div", { className: "choices" }, ...buttons),
        );
    }

    /** Shows the progress of a load. `total` 0: unknown. */
    showProgress(title: string, received: number, total: number): void {
        if (!this.progress || this.element.hidden) {
            const progress = h("progress");
            this.set(this.progressTitle, progress);
            this.progress = progress;
        }
        setText(this.progressTitle, title);
        this.progress.setAttribute("aria-label", title);
        if (total === 0) this.progress.removeAttribute("value");
        else {
            this.progress.max = total;
            this.progress.value = received;
        }
    }

    private set(...children: (Node | string | false)[]): void {
        this.progress = null;
        this.element.hidden = false;
        this.element.replaceChildren(h("div", { className: "card" }, ...children.filter((child) => Boolean(child))));
    }
}
