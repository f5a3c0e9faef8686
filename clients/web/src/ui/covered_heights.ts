/** Heights of the view that the bar at the top and the buttons at the bottom cover, in pixels. */

import { byId } from "./dom";

export function coveredHeights(stage: HTMLElement): { coveredTop: number; coveredBottom: number } {
    const view = stage.getBoundingClientRect();
    const [bar, dock] = ["bar", "dock"].map((id) => byId(id).getBoundingClientRect()) as [DOMRect, DOMRect];
    // A hidden element has no height.
    return {
        coveredTop: bar.height > 0 ? Math.max(0, bar.bottom - view.top) : 0,
        coveredBottom: dock.height > 0 ? Math.max(0, view.bottom - dock.top) : 0,
    };
}
