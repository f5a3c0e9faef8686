/** The row of one mode: its name, its deflection, and a slider or a bar for its coordinate. */

import { h, setText } from "./dom";
import * as format from "./format";
import { icon } from "./icons";

/** Milliseconds after an input in which a slider keeps its value, because the state with this value arrives later. */
const INPUT_MS = 1000;

/** Steps of a slider from its middle to an end. */
const STEPS = 200;

/** Label of a mode: its number, counted from 1, and its frequency if it is known. */
export function modeName(mode: number, hertz: number): string {
    return `Mode ${mode + 1}${hertz > 0 ? `, ${format.frequency(hertz)}` : ""}`;
}

export class ModeRow {
    readonly element: HTMLElement;
    private readonly value = h("span", { className: "value" });
    private readonly bar = h("i");
    private readonly slider: HTMLInputElement;
    private readonly play: HTMLButtonElement;
    private lastInput = -Infinity;
    /** q at the ends of the slider. */
    private end = 1;
    onInput: (q: number) => void = () => {};
    onPlay: () => void = () => {};

    /** @param metersPerQ Largest deflection in meters per unit of q; 0 if it is unknown. */
    constructor(
        readonly mode: number,
        readonly hertz: number,
        readonly metersPerQ: number,
    ) {
        const range = { min: String(-STEPS), max: String(STEPS), step: "1" };
        this.slider = h("input", { type: "range", ...range, aria: { label: `Mode ${mode + 1}` } });
        this.slider.oninput = () => {
            this.lastInput = performance.now();
            this.onInput((Number(this.slider.value) / STEPS) * this.end);
        };
        this.play = h(
            "button",
            { title: "Animate this mode", aria: { label: `Animate mode ${mode + 1}`, pressed: "false" } },
            icon("wave"),
        );
        this.play.onclick = () => this.onPlay();
        const track = h("div", { className: "track" }, this.bar);
        const name = h("span", { className: "name", textContent: modeName(mode, hertz) });
        this.element = h("div", { className: "mode" }, name, this.value, this.play, track, this.slider);
    }

    /** Shows a slider on the bar, and a button that animates the mode. */
    setControls(hasSlider: boolean, canAnimate: boolean): void {
        this.slider.hidden = !hasSlider;
        this.play.hidden = !canAnimate;
    }

    setAnimated(isAnimated: boolean): void {
        if (this.play.getAttribute("aria-pressed") === String(isAnimated)) return;
        this.play.setAttribute("aria-pressed", String(isAnimated));
        this.play.replaceChildren(icon(isAnimated ? "pause" : "wave"));
    }

    /**
     * @param end q at the ends of the track.
     * @param target q of the slider, which differs from q while a force moves the mode.
     */
    update(q: number, end: number, target = q): void {
        const text = this.deflectionText(q);
        setText(this.value, text);
        this.value.title = `q[${this.mode}] = ${format.short(q)}, counted from 0 as in programs`;
        this.bar.style.transform = `scaleX(${Math.max(-1, Math.min(1, q / end))})`;
        const { slider } = this;
        const isEdited = slider.matches(":active") || performance.now() - this.lastInput < INPUT_MS;
        if (document.activeElement === slider && isEdited) return;
        this.end = end;
        slider.value = String((STEPS * target) / end);
        slider.setAttribute("aria-valuetext", this.deflectionText(target));
    }

    private deflectionText(q: number): string {
        return this.metersPerQ > 0 ? format.signedMeters(q * this.metersPerQ) : `q = ${format.short(q)}`;
    }
}
