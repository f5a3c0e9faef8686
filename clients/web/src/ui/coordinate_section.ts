/** The panel section with the modes of one domain: sliders, or bars if sliders have no effect. */

import { missingModes } from "../control/pull_problem";
import { type Deflections, LARGEST_DEFLECTION } from "../scene/deflection";
import { hertzOf, rankOf } from "../scene/description";
import { FittedRange } from "../scene/fitted_range";
import { niceBelow } from "../scene/nice_numbers";
import { at } from "../scene/numbers";
import { RecentPeak } from "../scene/recent_peak";
import type { SceneModel } from "../scene/scene_model";
import type { SliderEffect } from "../session";
import { h, setMarkedText, setText } from "./dom";
import * as format from "./format";
import { ModeRow } from "./mode_row";

/** Modes that are shown at first, and after the user has asked for all. */
const FIRST_MODES = 10;
const MAX_MODES = 40;

/** Highest animation frequency in hertz, and the animation frequency of modes whose frequency is unknown. */
const FASTEST_HERTZ = 1;
const DEFAULT_HERTZ = 0.7;

const PART = "A part of the scene has its own mesh and modes. Programs call it a domain.";

export interface CoordinateHandlers {
    set(domain: number, mode: number, value: number): void;
    animate(domain: number, mode: number, amplitude: number, frequency: number): void;
    stop(): void;
    reset(domain: number): void;
    /** Whether a force can hold a mode, and the coordinate at which forces hold it. */
    canHold(domain: number, mode: number): boolean;
    target(domain: number, mode: number): number;
}

export class CoordinateSection {
    readonly element: HTMLElement;
    private model: SceneModel | null = null;
    private deflections: Deflections | null = null;
    private domain = 0;
    private rows: ModeRow[] = [];
    /** Deflection in meters at the ends of all bars. */
    private barRange = new FittedRange(0);
    private animated: number | null = null;
    private hintText = "";
    private effect: SliderEffect = "none";
    private readonly select: HTMLSelectElement;
    private readonly largest = h("output", { id: "deflection" });
    private readonly peak = h("span", { id: "peak", className: "hint" });
    private readonly largestRow: HTMLElement;
    private readonly pulled = h("output", { id: "pulled-deflection" });
    private readonly pulledRow: HTMLElement;
    private recentPeak = new RecentPeak();
    private showsAll = false;
    private readonly showAll = h("button", { className: "outline" });
    private readonly ends = [h("span"), h("span", { textContent: "0" }), h("span")] as const;
    private readonly scale: HTMLElement;
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
            h("label", { htmlFor: "q-domain", textContent: "Part", title: PART }),
            this.select,
        );
        this.showAll.onclick = () => {
            this.showsAll = !this.showsAll;
            this.show(this.domain);
            this.setAnimated(this.animated !== null);
        };
        const label = h("label", { htmlFor: "deflection", textContent: "Largest deflection" });
        const values = h("span", { className: "values" }, this.largest, this.peak);
        this.largestRow = h("div", { className: "row deflection" }, label, values);
        const pulledLabel = h("label", { htmlFor: "pulled-deflection", textContent: "Pulled point" });
        this.pulledRow = h("div", { className: "row deflection", hidden: true }, pulledLabel, this.pulled);
        this.scale = h("div", { className: "mode-scale" }, ...this.ends);
        this.element = h(
            "div",
            { className: "body" },
            this.row,
            this.hint,
            this.largestRow,
            this.pulledRow,
            this.scale,
            this.list,
            h("div", { className: "checks" }, this.showAll, this.reset),
        );
    }

    /** @param deflections Null if the viewer has no U. */
    setScene(model: SceneModel | null, deflections: Deflections | null): void {
        this.model = model;
        this.deflections = deflections;
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
        setMarkedText(this.hint, model ? missingModes(model.scene) : "");
        this.show(domains[0]?.domain ?? 0);
    }

    /** Shows the modes of a domain. */
    show(domain: number): void {
        const { model, deflections } = this;
        const description = model?.scene.domains[domain];
        const rank = model && description ? rankOf(model.scene, description) : 0;
        this.rows = [];
        this.list.replaceChildren();
        this.largestRow.hidden = this.scale.hidden = rank === 0 || !deflections;
        this.showAll.hidden = rank <= FIRST_MODES;
        if (!model || rank === 0) return;
        this.domain = at(model.layout.owner, domain);
        this.select.value = String(this.domain);
        const size = deflections?.size(this.domain) ?? 0;
        this.barRange = new FittedRange(size);
        this.recentPeak = new RecentPeak();
        this.scale.title = `The sliders end at up to ${100 * LARGEST_DEFLECTION} % of the part's size of ${format.meters(size)}.`;
        const count = Math.min(rank, MAX_MODES);
        setText(this.showAll, this.showsAll ? `Show ${FIRST_MODES} modes` : `Show all ${count} modes`);
        const length = this.showsAll ? count : Math.min(rank, FIRST_MODES);
        this.rows = Array.from({ length }, (_, mode) => this.createRow(model, mode));
        this.list.append(...this.rows.map((row) => row.element));
        if (this.showsAll && rank > MAX_MODES)
            this.list.append(h("p", { className: "hint", textContent: `and ${rank - MAX_MODES} more` }));
        this.setEffect(this.effect);
        this.update(null);
    }

    /** Shows sliders if they have an effect, otherwise bars. Without `hint`, the hint stays. */
    setEffect(effect: SliderEffect, hint = this.hintText): void {
        this.effect = effect;
        this.hintText = hint;
        for (const row of this.rows) {
            const canHold = effect === "forces" && this.handlers.canHold(this.domain, row.mode);
            row.setControls(effect === "steps" || canHold, effect === "steps");
        }
        this.reset.hidden = effect === "none" || this.rows.length === 0;
        if (this.rows.length > 0) setMarkedText(this.hint, hint);
        this.hint.hidden = !this.hint.textContent;
    }

    setAnimated(isAnimating: boolean): void {
        if (!isAnimating) this.animated = null;
        for (const row of this.rows) row.setAnimated(this.animated === row.mode);
    }

    /**
     * Shows the current coordinates if the section is visible.
     *
     * @param pulled Deflection of the pulled point in meters; null without a pull.
     */
    update(pulled: number | null): void {
        const { model, deflections } = this;
        if (!model || this.rows.length === 0 || !this.list.checkVisibility()) return;
        const q = model.state.qOf(this.domain);
        const largestOfModes = this.rows.reduce(
            (largest, { mode, metersPerQ }) => Math.max(largest, Math.abs(at(q, mode)) * metersPerQ),
            0,
        );
        const now = performance.now();
        this.barRange.update(largestOfModes, now);
        // Sliders reach at least their end, and do not flicker while physics moves the modes.
        const shown = this.effect === "steps" ? largestOfModes : this.barRange.end;
        const end = this.effect === "none" ? shown : Math.max(this.sliderEnd, shown);
        setText(this.ends[0], format.signedMeters(-end));
        setText(this.ends[2], format.signedMeters(end));
        for (const row of this.rows) {
            const value = at(q, row.mode);
            const target = this.effect === "forces" ? this.handlers.target(this.domain, row.mode) : value;
            row.update(value, row.metersPerQ > 0 ? end / row.metersPerQ : Math.max(1, Math.abs(value)), target);
        }
        if (!deflections) return;
        const isExact = deflections.isExact(this.domain);
        const count = format.count(deflections.count(this.domain));
        const about = isExact ? "" : "about ";
        const largest = deflections.largest(this.domain);
        const peak = this.recentPeak.add(largest, now);
        setText(this.largest, `${about}${format.meters(largest)}`);
        setText(this.peak, `peak ${format.meters(peak)}`);
        this.peak.hidden = this.effect === "steps" || peak === 0;
        this.pulledRow.hidden = pulled === null;
        setText(this.pulled, format.meters(pulled ?? 0));
        this.largest.title = `The largest distance of the part from its undeformed shape, at ${isExact ? "all" : "a selection of"} ${count} vertices.`;
    }

    /** Deflection in meters at the ends of all sliders. */
    private get sliderEnd(): number {
        return niceBelow(LARGEST_DEFLECTION * (this.deflections?.size(this.domain) ?? 0));
    }

    private createRow(model: SceneModel, mode: number): ModeRow {
        const hertz = hertzOf(model.scene, this.domain, mode);
        const row = new ModeRow(mode, hertz, this.deflections?.ofMode(this.domain, mode) ?? 0);
        row.onInput = (q) => {
            if (this.animated !== null) this.handlers.stop();
            this.animated = null;
            this.handlers.set(this.domain, mode, q);
        };
        row.onPlay = () => this.toggleAnimation(row);
        return row;
    }

    private toggleAnimation({ mode, hertz, metersPerQ }: ModeRow): void {
        const wasOn = this.animated === mode;
        this.animated = wasOn ? null : mode;
        const amplitude = 0.6 * (metersPerQ > 0 ? this.sliderEnd / metersPerQ : 1);
        if (wasOn) this.handlers.stop();
        // Real frequencies of stiff modes are too fast to see.
        else
            this.handlers.animate(
                this.domain,
                mode,
                amplitude,
                hertz > 0 ? Math.min(hertz, FASTEST_HERTZ) : DEFAULT_HERTZ,
            );
        this.setAnimated(this.animated !== null);
    }
}
