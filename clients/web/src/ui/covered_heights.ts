/** How much of the view the bar at the top and the buttons at the bottom cover. */

import { byId } from "./dom";

export function coveredHeights(stage: HTMLElement): { coveredTop: number; coveredBottom: number } {
    const { top, bottom } = stage.getBoundingClientRect();
    return {
        coveredTop: Math.max(0, byId("bar").getBoundingClientRect().bottom - top),
        coveredBottom: Math.max(0, bottom - byId("dock").getBoundingClientRect().top),
    };
}
