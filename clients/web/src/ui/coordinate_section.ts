/** The panel section with the coordinates q of one domain: bars while a program drives the scene, sliders otherwise. */

import { rankOf } from "../scene/description";
import { at } from "../scene/numbers";
import type { SceneModel } from "../scene/scene_model";
import { h, setText } from "./dom";
import * as format from "./format";
import { icon } from "./icons";

/** Modes shown at a time. */
const MAX_MODES = 40;

/** Milliseconds after the last key press in which a slider keeps its value: the state that shows it may arrive later. */
const INPUT_MS = 1000;

interface ModeRow {
    value: HTMLElement;
    bar: HTMLElement;
    track: HTMLElement;
    slider: HTMLInputElement;
    play: HTMLButtonElement;
}

export interface CoordinateHandlers {
    set(domain: number, mode: number, value: number): void;
    animate(domain: number, mode: number, amplitude: number, frequency: number): void;
    stop(): void;
    reset(domain: number): void;
}

export class CoordinateSection {
    readonly element: HTMLElement;
    private model: SceneModel | null = null;
    private domain = 0;
    private rows: ModeRow[] = [];
    /** Value of q at the end of each slider. */
    private ranges: number[] = [];
    private animated: number | null = null;
    private canDrive = false;
    private lastInput = -Infinity;
    private readonly select: HTMLSelectElement;
    private readonly list = h("div", { className: "modes" });
    private readonly hint = h("p", { className: "hint" });
    private readonly reset: HTMLButtonElement;
    private readonly row: HTMLElement;

    constructor(private readonly handlers: CoordinateHandlers) {
        this.select = h("select", { id: "q-domain" });
        this.select.onchange = () => this.show(Number(this.select.value));
        this.reset = h("button", { className: "outline", textContent: "Set all to 0" });
        this.reset.onclick = () => {
            this.animated = null;
            this.handlers.reset(this.domain);
        };
        this.row = h(
            "div",
            { className: "row" },
            h("label", { htmlFor: "q-domain", textContent: "Domain" }),
            this.select,
        );
        this.element = h(
            "div",
            { className: "body" },
            this.row,
            this.hint,
            this.list,
            h("div", { className: "checks" }, this.reset),
        );
    }

    /** @param modeNorms Largest displacement of each mode of a domain in scene units per unit of q, if it is known. */
    setScene(model: SceneModel | null, modeNorms: (domain: number) => ArrayLike<number> | null): void {
        this.model = model;
        this.modeNorms = modeNorms;
        this.animated = null;
        const domains = (model?.scene.domains ?? []).filter(
            (domain) => model && rankOf(model.scene, domain) > 0 && domain.sharesQWith === undefined,
        );
        this.select.replaceChildren(
            ...domains
                .slice(0, 500)
                .map((domain) => h("option", { value: String(domain.domain), textContent: domain.name })),
        );
        this.row.hidden = domains.length < 2;
        this.reset.hidden = domains.length === 0;
        setText(this.hint, domains.length === 0 && model ? "No domain of this scene has modes." : "");
        this.show(domains[0]?.domain ?? 0);
    }

    /** Shows the coordinates of a domain. */
    show(domain: number): void {
        const { model } = this;
        const description = model?.scene.domains[domain];
        if (!model || !description || rankOf(model.scene, description) === 0) {
            this.list.replaceChildren();
            this.rows = [];
            return;
        }
        this.domain = at(model.layout.owner, domain);
        this.select.value = String(this.domain);
        const eigenvalues = description.eigenvalues?.values ?? model.scene.shapes[description.shape]?.eigenvalues ?? [];
        const norms = this.modeNorms(domain);
        const size = this.diagonalOf(model);
        const rank = rankOf(model.scene, description);
        this.ranges = Array.from({ length: rank }, (_, mode) => {
            const norm = norms ? at(norms, mode) : 0;
            return norm > 0 ? (0.08 * size) / norm : 1;
        });
        this.rows = [];
        this.list.replaceChildren(
            ...Array.from({ length: Math.min(rank, MAX_MODES) }, (_, mode) => this.modeRow(mode, eigenvalues[mode])),
        );
        if (rank > MAX_MODES)
            this.list.append(h("p", { className: "hint", textContent: `and ${rank - MAX_MODES} more` }));
        this.setCanDrive(this.canDrive);
        this.update();
    }

    /** Shows sliders if this viewer can drive the scene, otherwise bars. */
    setCanDrive(canDrive: boolean, hint = ""): void {
        this.canDrive = canDrive;
        for (const { slider, track, play } of this.rows) {
            slider.hidden = !canDrive;
            track.hidden = canDrive;
            play.disabled = !canDrive;
        }
        this.reset.disabled = !canDrive;
        if (this.rows.length > 0) setText(this.hint, hint);
        this.hint.hidden = !this.hint.textContent;
    }

    setAnimated(isAnimating: boolean): void {
        if (!isAnimating) this.animated = null;
        this.rows.forEach(({ play }, mode) => {
            const isOn = this.animated === mode;
            if (play.getAttribute("aria-pressed") === String(isOn)) return;
            play.setAttribute("aria-pressed", String(isOn));
            play.replaceChildren(icon(isOn ? "pause" : "wave"));
        });
    }

    update(): void {
        const { model } = this;
        if (!model || this.rows.length === 0) return;
        const q = model.state.qOf(this.domain);
        this.rows.forEach(({ value, bar, slider }, mode) => {
            const current = at(q, mode);
            const range = Math.max(at(this.ranges, mode), Math.abs(current));
            this.ranges[mode] = range;
            setText(value, format.short(current));
            bar.style.transform = `scaleX(${current / range})`;
            const isEdited = slider.matches(":active") || performance.now() - this.lastInput < INPUT_MS;
            if (document.activeElement !== slider || !isEdited) {
                slider.max = String(range);
                slider.min = String(-range);
                slider.step = String(range / 200);
                slider.value = String(current);
            }
        });
    }

    private modeNorms: (domain: number) => ArrayLike<number> | null = () => null;

    private diagonalOf({ scene }: SceneModel): number {
        const { bounds } = scene.info;
        return Math.hypot(...[0, 1, 2].map((axis) => at(bounds, 3 + axis) - at(bounds, axis)));
    }

    private modeRow(mode: number, eigenvalue: number | undefined): HTMLElement {
        const hertz = eigenvalue !== undefined && eigenvalue > 0 ? Math.sqrt(eigenvalue) / (2 * Math.PI) : 0;
        const bar = h("i");
        const track = h("div", { className: "track" }, bar);
        const slider = h("input", { type: "range", aria: { label: `Coordinate ${mode + 1}` } });
        slider.oninput = () => {
            this.lastInput = performance.now();
            if (this.animated !== null) this.handlers.stop();
            this.animated = null;
            this.handlers.set(this.domain, mode, Number(slider.value));
        };
        const play = h(
            "button",
            { title: "Animate this mode", aria: { label: `Animate mode ${mode + 1}`, pressed: "false" } },
            icon("wave"),
        );
        play.onclick = () => {
            const wasOn = this.animated === mode;
            this.animated = wasOn ? null : mode;
            if (wasOn) this.handlers.stop();
            // Real frequencies of stiff modes are too fast to see.
            else
                this.handlers.animate(
                    this.domain,
                    mode,
                    0.6 * at(this.ranges, mode),
                    hertz > 0 ? Math.min(hertz, 1) : 0.7,
                );
            this.setAnimated(this.animated !== null);
        };
        const value = h("span", { className: "value" });
        this.rows.push({ value, bar, track, slider, play });
        const name = h("span", { className: "name", textContent: `q${mode + 1}` });
        const frequency = h("span", { className: "name", textContent: hertz > 0 ? format.frequency(hertz) : "" });
        return h("div", { className: "mode" }, name, frequency, h("div", {}, track, slider), value, play);
    }
}
