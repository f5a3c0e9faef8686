/** Pulls with a pointer: Shift + drag, or a plain drag while the tool is active. */

import type { PullTool } from "./pull";

const END_EVENTS = ["pointerup", "pointercancel", "lostpointercapture"] as const;

export class PullGesture {
    /** Whether a plain drag pulls. */
    isActive = false;
    /** The tool of the scene that is shown; null if it does not react to forces. */
    tool: () => PullTool | null = () => null;
    /** A drag that should pull found no tool. */
    onUnavailable: () => void = () => {};
    /** The line to the cursor has changed. */
    onMove: () => void = () => {};

    constructor(private readonly stage: HTMLElement) {
        // In the capture phase, before the camera's controls see the event.
        stage.addEventListener("pointerdown", (event) => this.begin(event), { capture: true });
    }

    private begin(event: PointerEvent): void {
        const { stage } = this;
        stage.focus({ preventScroll: true });
        if (event.button !== 0 || !event.isPrimary || !(event.shiftKey || this.isActive)) return;
        event.stopImmediatePropagation();
        const tool = this.tool();
        if (!tool) return this.onUnavailable();
        const box = stage.getBoundingClientRect();
        const place = (move: PointerEvent): [number, number] => [move.clientX - box.left, move.clientY - box.top];
        stage.setPointerCapture(event.pointerId);
        const move = (next: PointerEvent) => {
            if (next.pointerId !== event.pointerId) return;
            tool.move(...place(next));
            this.onMove();
        };
        const end = (last: PointerEvent) => {
            if (last.pointerId !== event.pointerId) return;
            stage.removeEventListener("pointermove", move);
            for (const name of END_EVENTS) stage.removeEventListener(name, end);
            tool.end();
            this.onMove();
        };
        stage.addEventListener("pointermove", move);
        for (const name of END_EVENTS) stage.addEventListener(name, end);
        void tool.begin(...place(event), [Math.floor(box.width), Math.floor(box.height)]);
    }
}
