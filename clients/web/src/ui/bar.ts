/** The bar at the top: scene, connection, and the time scale of slow or fast motion. */

import { byId, h, setText } from "./dom";
import { icon } from "./icons";

export type ConnectionState = "good" | "warn" | "bad" | "idle";

export class Bar {
    private readonly menu: HTMLSelectElement;
    private readonly dot = h("i", { className: "dot" });
    private readonly text = h("span");
    private readonly timeScale = h("div", { id: "time-scale", hidden: true });
    private readonly panelButton: HTMLButtonElement;
    onScene: (value: string) => void = () => {};
    onPanel: () => void = () => {};

    constructor() {
        this.menu = h("select", { id: "scene-menu", aria: { label: "Scene" } });
        this.menu.onchange = () => this.onScene(this.menu.value);
        this.panelButton = h(
            "button",
            { className: "icon", title: "Panels (B)", aria: { label: "Panels", expanded: "true" } },
            icon("panel"),
        );
        this.panelButton.onclick = () => this.onPanel();
        const brand = h("div", { className: "brand" }, icon("logo"), h("span", { textContent: "modalcast" }));
        const connection = h("div", { id: "connection", aria: { role: "status" } }, this.dot, this.text);
        byId("bar").append(brand, this.menu, connection, this.timeScale, this.panelButton);
    }

    /** Values are "open:NAME" and "source:SOURCE". */
    setScenes(open: string[], sources: string[], current: string): void {
        const option = (value: string, text: string) => h("option", { value, textContent: text });
        const group = (label: string, options: HTMLOptionElement[]) => {
            const element = h("optgroup", { label });
            element.append(...options);
            return element;
        };
        const groups = [
            group(
                "Open",
                open.map((name) => option(`open:${name}`, name)),
            ),
        ];
        if (sources.length > 0)
            groups.push(
                group(
                    "Open another",
                    sources.map((source) => option(`source:${source}`, source)),
                ),
            );
        this.menu.replaceChildren(...groups);
        this.menu.value = `open:${current}`;
        this.menu.hidden = open.length === 0;
    }

    setConnection(state: ConnectionState, text: string): void {
        this.dot.className = `dot ${state}`;
        setText(this.text, text);
        this.text.parentElement?.setAttribute("title", text);
    }

    /** Shows a text on the time scale; an empty one hides it. */
    setTimeScale(text: string): void {
        this.timeScale.hidden = text === "";
        setText(this.timeScale, text);
    }

    setPanelOpen(isOpen: boolean): void {
        this.panelButton.setAttribute("aria-expanded", String(isOpen));
    }
}
