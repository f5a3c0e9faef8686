/** What the user has chosen. */

import type { BackgroundChoice, ColorChoice } from "../render/scene_renderer";

export interface Settings {
    /** Whether the server draws. */
    pictures: boolean;
    jpeg: boolean;
    shadows: boolean;
    edges: boolean;
    color: ColorChoice;
    background: BackgroundChoice;
}

export function defaultSettings(): Settings {
    return {
        pictures: false,
        jpeg: true,
        shadows: true,
        edges: false,
        color: { kind: "shaded" },
        background: "scene",
    };
}
