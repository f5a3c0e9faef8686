/** The panel section with the domains of the scene. */

import type { SceneDescription } from "../scene/description";
import { rankOf } from "../scene/description";
import { h, setText } from "./dom";
import { count } from "./format";

/** Rows shown at a time: a plant has thousands of domains. */
const MAX_ROWS = 200;

export class DomainSection {
    readonly element: HTMLElement;
    readonly hidden = new Set<number>();
    selected: number | null = null;
    private scene: SceneDescription | null = null;
    private readonly filter: HTMLInputElement;
    private readonly list = h("div", { className: "domains", aria: { role: "list" } });
    private readonly more = h("p", { className: "hint" });
    onChange: () => void = () => {};
    onSelect: (domain: number | null) => void = () => {};

    constructor() {
        this.filter = h("input", {
            type: "search",
            placeholder: "Filter by name",
            aria: { label: "Filter parts by name" },
        });
        this.filter.oninput = () => this.build();
        const all = h("button", { className: "outline", textContent: "Show all" });
        all.onclick = () => {
            this.hidden.clear();
            this.build();
            this.onChange();
        };
        const invert = h("button", {
            className: "outline",
            textContent: "Hide others",
            title: "Hide all parts but the listed ones",
        });
        invert.onclick = () => {
            const listed = new Set(this.matches());
            for (const domain of this.scene?.domains ?? []) {
                if (listed.has(domain.domain)) this.hidden.delete(domain.domain);
                else this.hidden.add(domain.domain);
            }
            this.build();
            this.onChange();
        };
        this.element = h(
            "div",
            { className: "body" },
            this.filter,
            this.list,
            this.more,
            h("div", { className: "checks" }, all, invert),
        );
    }

    setScene(scene: SceneDescription | null): void {
        this.scene = scene;
        this.hidden.clear();
        this.selected = null;
        this.filter.value = "";
        this.filter.hidden = (scene?.domains.length ?? 0) < 8;
        this.build();
    }

    select(domain: number | null): void {
        this.selected = this.selected === domain ? null : domain;
        this.build();
        this.onSelect(this.selected);
        this.onChange();
    }

    private matches(): number[] {
        const text = this.filter.value.trim().toLowerCase();
        return (this.scene?.domains ?? [])
            .filter((domain) => domain.name.toLowerCase().includes(text))
            .map((domain) => domain.domain);
    }

    private build(): void {
        const { scene } = this;
        if (!scene) return this.list.replaceChildren();
        const matches = this.matches();
        this.list.replaceChildren(...matches.slice(0, MAX_ROWS).map((domain) => this.row(scene, domain)));
        const rest = matches.length - MAX_ROWS;
        setText(this.more, rest > 0 ? `and ${count(rest)} more: filter by name to list them` : "");
        this.more.hidden = rest <= 0;
    }

    private row(scene: SceneDescription, index: number): HTMLElement {
        const domain = scene.domains[index];
        const name = domain?.name ?? String(index);
        const visible = h("input", {
            type: "checkbox",
            checked: !this.hidden.has(index),
            aria: { label: `Show ${name}` },
        });
        visible.onchange = () => {
            if (visible.checked) this.hidden.delete(index);
            else this.hidden.add(index);
            this.onChange();
        };
        const button = h("button", { textContent: name, title: `Highlight ${name}` });
        button.onclick = () => this.select(index);
        const rank = domain ? rankOf(scene, domain) : 0;
        const meta = h("span", {
            className: "meta",
            textContent: rank > 0 ? (rank === 1 ? "1 mode" : `${rank} modes`) : "rigid",
        });
        const row = h("div", { className: "domain", aria: { role: "listitem" } }, visible, button, meta);
        row.classList.toggle("selected", this.selected === index);
        return row;
    }
}
