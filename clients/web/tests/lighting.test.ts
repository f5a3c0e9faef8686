/** Light of a scene, and displayed colors. */

import assert from "node:assert/strict";
import { test } from "node:test";
import { create } from "@bufbuild/protobuf";
import { LightingSchema } from "../src/proto/modalcast/v1/scenes_pb";
import { texelsFromPixels } from "../src/render/ambient_occlusion";
import { cssColor, displayedOf, groundColor, keepsBackground, lightingOf, lightOf } from "../src/render/lighting";
import type { SceneDescription } from "../src/scene/description";
import { backgroundName } from "../src/ui/view_section";
import { fourDomains } from "./scene";

function sceneWith(lighting: Parameters<typeof create<typeof LightingSchema>>[1], up = "y"): SceneDescription {
    const scene = fourDomains();
    scene.info.up = up;
    scene.info.lighting = create(LightingSchema, lighting);
    return scene;
}

const CUBE = Array.from({ length: 18 }, (_, index) => index / 18);

test("the sides of the ambient cube and the fill light are those of the message", () => {
    const { studio, ambientOcclusionRadius } = lightingOf(
        sceneWith({ ambientCube: CUBE, fill: [0.1, 0.2, 0.3], ambientOcclusionRadius: 0.15 }),
    );
    assert.deepEqual(studio?.ambientCube[0], CUBE.slice(0, 3));
    assert.deepEqual(studio?.ambientCube[5], CUBE.slice(15));
    assert.deepEqual(studio?.fill, [0.1, 0.2, 0.3]);
    assert.equal(ambientOcclusionRadius, 0.15);
});

test("a missing cube is the skylight, and a missing fill light is dark", () => {
    const skylight = [0.25, 0.5, 0.75];
    const withFill = lightingOf(sceneWith({ skylight, fill: [1, 1, 1] }));
    assert.deepEqual(withFill.studio?.ambientCube, Array(6).fill(skylight));
    assert.deepEqual(lightingOf(sceneWith({ ambientCube: CUBE })).studio?.fill, [0, 0, 0]);
    const outdoor = lightingOf(sceneWith({ skylight }));
    assert.equal(outdoor.studio, null);
    assert.equal(outdoor.ambientOcclusionRadius, 0);
});

test("a scene with an ambient cube is viewed from higher up", () => {
    assert.deepEqual(lightingOf(sceneWith({ ambientCube: CUBE })).toCamera, [0.58, 0.46, 0.82]);
    assert.deepEqual(lightingOf(sceneWith({ ambientCube: CUBE }, "z")).toCamera, [0.58, -0.82, 0.46]);
    assert.deepEqual(lightingOf(sceneWith({})).toCamera, [0.42, 0.14, 0.9]);
    // Servers of older versions send no lighting.
    assert.deepEqual(lightingOf(fourDomains()).toCamera, [0.42, 0.14, 0.9]);
});

test("the color of the ground is its lit and displayed color", () => {
    const sun = { toSun: [0, 1, 0], sunlight: [1, 1, 1], skylight: [0.5, 0.5, 0.5], horizon: [0.3, 0.4, 0.5] };
    const ground = sceneWith({ ...sun, ground: [0.2, 0.4, 0.6], exposure: 1 });
    assert.deepEqual(
        groundColor(lightingOf(ground), 1).map((value) => Number(value.toFixed(6))),
        [0.3, 0.6, 0.9],
    );
    // Without a ground, the horizon; in a studio, the ambient light of the upper side.
    assert.deepEqual(groundColor(lightingOf(sceneWith({ ...sun, exposure: 1 })), 1), [0.3, 0.4, 0.5]);
    const studio = lightingOf(sceneWith({ ...sun, ground: [1, 1, 1], ambientCube: CUBE, exposure: 1 }));
    const [red] = groundColor({ ...studio, sunlight: [0, 0, 0] }, 1);
    assert.ok(Math.abs(red - (CUBE[6] ?? 0)) < 1e-9, `${red}`);
    for (const tone of [0, 1, 2])
        for (const value of [0.1, 0.5, 0.9]) {
            const curve = { exposure: 1.5, tone };
            assert.ok(Math.abs(displayedOf(lightOf(value, curve), curve) - value) < 1e-9);
        }
    assert.equal(cssColor([0, 0.5, 1]), "rgb(0 188 255)");
});

test("a background has the name of what is shown", () => {
    const outdoor = lightingOf(sceneWith({ skylight: [1, 1, 1], ground: [1, 1, 1] }));
    const studio = lightingOf(sceneWith({ ambientCube: CUBE, ground: [1, 1, 1] }));
    const names = [outdoor, studio, { ...outdoor, ground: null }].map(backgroundName);
    assert.deepEqual(names, ["Sky and ground", "Studio", "Sky"]);
    assert.deepEqual([outdoor, studio].map(keepsBackground), [false, true]);
});

test("texels of images of odd size are at the centers of pixels", () => {
    for (const pixels of [
        { x: 640, y: 480 },
        { x: 641, y: 7 },
    ]) {
        const texels = { width: Math.ceil(pixels.x / 2), height: Math.ceil(pixels.y / 2) };
        const { elements } = texelsFromPixels(pixels, texels);
        for (const texel of [0, 1, texels.width - 1]) {
            // The center of pixel 2 * texel in normalized device coordinates of the canvas.
            const ndc = (2 * (2 * texel + 0.5)) / pixels.x - 1;
            const mapped = (elements[0] ?? 0) * ndc + (elements[12] ?? 0);
            assert.ok(Math.abs(((mapped + 1) / 2) * texels.width - (texel + 0.5)) < 1e-9, `${pixels.x}: ${mapped}`);
        }
        const ndc = (2 * (2 * 3 + 0.5)) / pixels.y - 1;
        const mapped = (elements[5] ?? 0) * ndc + (elements[13] ?? 0);
        assert.ok(Math.abs(((mapped + 1) / 2) * texels.height - 3.5) < 1e-9, `${pixels.y}: ${mapped}`);
    }
});

/** The tone curve of the shaders. */
function displayed(light: number, exposure: number, tone: number): number {
    let value = Math.min(light * exposure, 65504);
    if (tone === 1) value = value / (1 + value);
    if (tone === 2) value = (value * (2.51 * value + 0.03)) / (value * (2.43 * value + 0.59) + 0.14);
    return Math.min(value, 1);
}

test("the tone curve displays the light of a color as this color", () => {
    for (const tone of [0, 1, 2]) {
        for (const exposure of [0.5, 1, 3]) {
            for (const color of [0, 0.2, 0.87, 1]) {
                const shown = displayed(lightOf(color, { exposure, tone }), exposure, tone);
                assert.ok(Math.abs(shown - color) < 1e-4, `expected ${color} with tone curve ${tone}, got ${shown}`);
            }
        }
    }
});
