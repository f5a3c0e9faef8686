/** The time line of a recording. */

import type { Playback } from "../source/playback";
import { byId, h, setText } from "./dom";
import * as format from "./format";
import { icon } from "./icons";

const SPEEDS = [0.001, 0.01, 0.1, 0.25, 0.5, 1, 2, 4];

export class Timeline {
    private readonly element: HTMLElement;
    private readonly play: HTMLButtonElement;
    private readonly slider: HTMLInputElement;
    private readonly now = h("output");

    constructor(private readonly playback: Playback) {
        this.play = h("button", { className: "icon", aria: { label: "Play" } });
        this.play.onclick = () => playback.toggle();
        const step = h(
            "button",
            { className: "icon step", title: "Next step (→)", aria: { label: "Next step" } },
            icon("step"),
        );
        step.onclick = () => playback.step(1);
        this.slider = h("input", {
            type: "range",
            min: "0",
            max: String(playback.duration),
            step: "any",
            aria: { label: "Time in seconds" },
        });
        this.slider.oninput = () => playback.seek(Number(this.slider.value));
        const total = h("span", { className: "total", textContent: format.seconds(playback.duration) });
        const speed = h("select", { title: "Speed", aria: { label: "Speed" } });
        const speeds = [...new Set([...SPEEDS, playback.speed])].sort((a, b) => a - b);
        speed.append(
            ...speeds.map((value) =>
                h("option", {
                    value: String(value),
                    textContent: format.speed(value),
                    selected: value === playback.speed,
                }),
            ),
        );
        speed.onchange = () => {
            playback.speed = Number(speed.value);
        };
        const loop = h(
            "button",
            { className: "icon", title: "Loop", aria: { label: "Loop", pressed: String(playback.loops) } },
            icon("loop"),
        );
        loop.onclick = () => {
            playback.loops = !playback.loops;
            loop.setAttribute("aria-pressed", String(playback.loops));
        };
        const ends = h("span", { className: "times" }, this.now, " / ", total);
        this.element = h(
            "div",
            { id: "timeline", className: "card", aria: { role: "group", label: "Time line" } },
            this.play,
            step,
            this.slider,
            ends,
            speed,
            loop,
        );
        byId("dock").prepend(this.element);
        playback.onChange = () => this.update();
        this.update();
    }

    remove(): void {
        this.element.remove();
    }

    private update(): void {
        const { playback } = this;
        const label = playback.isPlaying ? "Pause" : "Play";
        if (this.play.title !== label) {
            this.play.replaceChildren(icon(playback.isPlaying ? "pause" : "play"));
            this.play.title = label;
            this.play.setAttribute("aria-label", label);
        }
        if (!this.slider.matches(":active")) this.slider.value = String(playback.time);
        this.slider.setAttribute("aria-valuetext", format.seconds(playback.time, playback.duration));
        setText(this.now, format.seconds(playback.time, playback.duration));
    }
}
