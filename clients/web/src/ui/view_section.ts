/** The panel section that selects whether the browser or the server draws, and what. */

import { keepsBackground, type Lighting } from "../render/lighting";
import type { BackgroundChoice } from "../render/scene_renderer";
import { h, setText } from "./dom";
import type { Settings } from "./settings";

/** The background of a scene, in words. */
export function backgroundName({ studio, ground }: Pick<Lighting, "studio" | "ground">): string {
    if (studio) return "Studio";
    return ground ? "Sky and ground" : "Sky";
}

export class ViewSection {
    readonly element: HTMLElement;
    private readonly local: HTMLButtonElement;
    private readonly server: HTMLButtonElement;
    private readonly hint = h("p", { className: "hint" });
    private readonly color: HTMLSelectElement;
    private readonly mode: HTMLInputElement;
    private readonly modeRow: HTMLElement;
    private readonly jpegRow: HTMLElement;
    private readonly edges: HTMLInputElement;
    private readonly shadows: HTMLInputElement;
    private readonly background: HTMLSelectElement;
    private readonly ownBackground = h("option", { value: "scene", textContent: "Sky and ground" });
    private readonly jpeg: HTMLSelectElement;
    private mapsKeepBackground = false;
    private readonly switchRow: HTMLElement;
    onChange: () => void = () => {};

    constructor(private readonly settings: Settings) {
        this.local = h("button", {
            textContent: "Browser",
            title: "Load the mesh and the modes once, then receive only the motion",
        });
        this.server = h("button", { textContent: "Server", title: "Show the pictures that the server draws" });
        this.local.onclick = () => this.set(() => (settings.pictures = false));
        this.server.onclick = () => this.set(() => (settings.pictures = true));
        this.switchRow = h(
            "div",
            { className: "row" },
            h("span", { className: "label", textContent: "Drawn by" }),
            h("div", { className: "segments", aria: { role: "group", label: "Drawn by" } }, this.local, this.server),
        );
        this.color = h(
            "select",
            { id: "color" },
            h("option", { value: "shaded", textContent: "Materials" }),
            h("option", { value: "displacement", textContent: "Deflection" }),
            h("option", { value: "mode", textContent: "Shape of a mode" }),
        );
        this.mode = h("input", { id: "mode", type: "number", min: "1", value: "1", step: "1" });
        this.color.onchange = () => this.set(() => this.readColor());
        this.mode.oninput = () => this.set(() => this.readColor());
        this.modeRow = h("div", { className: "row" }, h("label", { htmlFor: "mode", textContent: "Mode" }), this.mode);
        this.shadows = h("input", { type: "checkbox", checked: settings.shadows });
        this.edges = h("input", { type: "checkbox", checked: settings.edges });
        this.shadows.onchange = () => this.set(() => (settings.shadows = this.shadows.checked));
        this.edges.onchange = () => this.set(() => (settings.edges = this.edges.checked));
        this.jpeg = h(
            "select",
            { id: "format" },
            h("option", { value: "jpeg", textContent: "JPEG, smaller" }),
            h("option", { value: "png", textContent: "PNG, exact" }),
        );
        this.jpeg.onchange = () => this.set(() => (settings.jpeg = this.jpeg.value === "jpeg"));
        this.jpegRow = h(
            "div",
            { className: "row" },
            h("label", { htmlFor: "format", textContent: "Pictures" }),
            this.jpeg,
        );
        this.background = h(
            "select",
            { id: "background" },
            this.ownBackground,
            h("option", { value: "gray", textContent: "Light gray" }),
            h("option", { value: "white", textContent: "White" }),
        );
        this.background.onchange = () =>
            this.set(() => (settings.background = this.background.value as BackgroundChoice));
        const checks = h(
            "div",
            { className: "checks" },
            h("label", {}, this.shadows, "Shadows"),
            h("label", {}, this.edges, "Mesh edges"),
        );
        this.element = h(
            "div",
            { className: "body" },
            this.switchRow,
            this.hint,
            h("div", { className: "row" }, h("label", { htmlFor: "color", textContent: "Color" }), this.color),
            this.modeRow,
            h(
                "div",
                { className: "row" },
                h("label", { htmlFor: "background", textContent: "Background" }),
                this.background,
            ),
            this.jpegRow,
            checks,
        );
        this.refresh();
    }

    /** Disables drawing by the browser or by the server, and shows the reason. */
    restrict(canDrawLocally: boolean, canUseServer: boolean, hint: string): void {
        this.local.disabled = !canDrawLocally;
        this.server.disabled = !canUseServer;
        this.switchRow.hidden = !canUseServer && canDrawLocally;
        setText(this.hint, hint);
        this.refresh();
    }

    /** Names the background of a scene, and whether color maps keep it. */
    setBackground(lighting: Pick<Lighting, "studio" | "ground">): void {
        setText(this.ownBackground, backgroundName(lighting));
        this.mapsKeepBackground = keepsBackground(lighting);
        this.refresh();
    }

    setModes(largestRank: number): void {
        this.mode.max = String(Math.max(1, largestRank));
        for (const option of this.color.options) option.disabled = option.value !== "shaded" && largestRank === 0;
        if (largestRank === 0 && this.settings.color.kind !== "shaded") {
            this.settings.color = { kind: "shaded" };
            this.color.value = "shaded";
        }
        this.refresh();
    }

    /** Selects the next color map, without `onChange`. */
    nextColor(): void {
        this.color.selectedIndex = (this.color.selectedIndex + 1) % this.color.options.length;
        this.readColor();
    }

    refresh(): void {
        const { settings } = this;
        this.local.setAttribute("aria-pressed", String(!settings.pictures));
        this.server.setAttribute("aria-pressed", String(settings.pictures));
        this.hint.hidden = !this.hint.textContent;
        this.modeRow.hidden = settings.color.kind !== "mode";
        this.jpegRow.hidden = !settings.pictures;
        this.shadows.disabled = settings.pictures || (settings.color.kind !== "shaded" && !this.mapsKeepBackground);
        // The server draws the background of its pictures.
        this.background.disabled = settings.pictures;
        this.edges.checked = settings.edges;
        this.shadows.checked = settings.shadows;
    }

    private set(change: () => void): void {
        change();
        this.refresh();
        this.onChange();
    }

    private readColor(): void {
        const mode = Math.max(0, Math.min(Number(this.mode.max), Math.round(Number(this.mode.value) || 1)) - 1);
        const kind = this.color.value;
        this.settings.color = kind === "mode" ? { kind, mode } : { kind: kind === "displacement" ? kind : "shaded" };
    }
}
