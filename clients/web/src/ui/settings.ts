/** What the user has chosen. */

import type { ColorChoice } from "../render/scene_renderer";

export interface Settings {
    /** Whether the server draws. */
    pictures: boolean;
    jpeg: boolean;
    shadows: boolean;
    edges: boolean;
    color: ColorChoice;
}

export function defaultSettings(): Settings {
    return { pictures: false, jpeg: true, shadows: true, edges: false, color: { kind: "shaded" } };
}
