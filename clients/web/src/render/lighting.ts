/** Light, sky and ground of a scene. Colors are linear RGB, and vectors are in world axes. */

import { type Lighting as LightingMessage, ToneMapping } from "../proto/modalcast/v1/scenes_pb";
import { cross, dot, norm, type Vec3 } from "../scene/affine";
import type { SceneDescription } from "../scene/description";
import { at } from "../scene/numbers";

export interface Lighting {
    toSun: Vec3;
    sunlight: Vec3;
    skylight: Vec3;
    zenith: Vec3;
    horizon: Vec3;
    ground: Vec3 | null;
    /** Null if the ambient light is `skylight` for every normal, and there is no fill light. */
    studio: StudioLight | null;
    /** Radius as a fraction of the diagonal of the scene at rest; 0 without ambient occlusion. */
    ambientOcclusionRadius: number;
    shadows: boolean;
    exposure: number;
    /** 0: none, 1: Reinhard, 2: ACES. */
    tone: number;
    /** Direction from the scene to the default camera, not normalized. */
    toCamera: Vec3;
}

export interface StudioLight {
    /** Colors of the sides +x, -x, +y, -y, +z and -z. */
    ambientCube: readonly Vec3[];
    /** Fill light at the camera, which is diffuse and casts no shadow. */
    fill: Vec3;
}

/** Directions from the scene to the server's default camera, in Y-up coordinates. */
const OUTDOOR_CAMERA: Vec3 = [0.42, 0.14, 0.9];
const STUDIO_CAMERA: Vec3 = [0.58, 0.46, 0.82];

export type UpAxis = 0 | 1 | 2;

export function upAxis(scene: SceneDescription): UpAxis {
    const index = ["x", "y", "z"].indexOf(scene.info.up);
    return index === 0 || index === 2 ? index : 1;
}

export function unitVector(axis: UpAxis): Vec3 {
    return [0, 1, 2].map((index) => (index === axis ? 1 : 0)) as Vec3;
}

/** Rotates a vector from Y-up coordinates to the up axis of a scene, as the server does. */
export function fromYUp([x, y, z]: Vec3, axis: UpAxis): Vec3 {
    if (axis === 0) return [y, -x, z];
    return axis === 2 ? [x, -z, y] : [x, y, z];
}

export function normalized(vector: Vec3): Vec3 {
    const length = norm(vector);
    return length > 0 ? (vector.map((component) => component / length) as Vec3) : [0, 1, 0];
}

/** Defaults of the table `look` of a scene.toml, for servers that do not send SceneInfo.lighting. */
function defaultLighting(axis: UpAxis): Lighting {
    return {
        toSun: normalized(fromYUp([0.45, 0.8, 0.55], axis)),
        sunlight: [0.82, 0.77, 0.69],
        skylight: [0.25, 0.28, 0.33],
        zenith: [0.1, 0.27, 0.58],
        horizon: [0.34, 0.54, 0.79],
        ground: [0.4, 0.41, 0.36],
        studio: null,
        ambientOcclusionRadius: 0,
        shadows: true,
        exposure: 1,
        tone: 0,
        toCamera: fromYUp(OUTDOOR_CAMERA, axis),
    };
}

export function lightingOf(scene: SceneDescription): Lighting {
    const { lighting } = scene.info;
    const axis = upAxis(scene);
    const defaults = defaultLighting(axis);
    if (!lighting) return defaults;
    const vector = (value: number[], fallback: Vec3) => (value.length === 3 ? (value as Vec3) : fallback);
    const skylight = vector(lighting.skylight, defaults.skylight);
    return {
        toSun: normalized(vector(lighting.toSun, defaults.toSun)),
        sunlight: vector(lighting.sunlight, defaults.sunlight),
        skylight,
        zenith: vector(lighting.zenith, defaults.zenith),
        horizon: vector(lighting.horizon, defaults.horizon),
        ground: lighting.ground.length === 3 ? (lighting.ground as Vec3) : null,
        studio: studioOf(lighting, skylight),
        ambientOcclusionRadius: lighting.ambientOcclusionRadius ?? 0,
        shadows: lighting.shadows,
        exposure: lighting.exposure,
        tone: lighting.toneMapping === ToneMapping.REINHARD ? 1 : lighting.toneMapping === ToneMapping.ACES ? 2 : 0,
        // The description does not name the lighting. Only studio lighting has an ambient cube.
        toCamera: fromYUp(lighting.ambientCube.length > 0 ? STUDIO_CAMERA : OUTDOOR_CAMERA, axis),
    };
}

function studioOf({ ambientCube, fill }: LightingMessage, skylight: Vec3): StudioLight | null {
    if (ambientCube.length !== 18 && fill.length !== 3) return null;
    const side = (first: number) => ambientCube.slice(first, first + 3) as Vec3;
    return {
        ambientCube: [0, 3, 6, 9, 12, 15].map((first) => (ambientCube.length === 18 ? side(first) : skylight)),
        fill: fill.length === 3 ? (fill as Vec3) : [0, 0, 0],
    };
}

/** Whether color maps are drawn in front of the background of the scene. A blue sky would be confused with their colors. */
export function keepsBackground({ studio }: Pick<Lighting, "studio">): boolean {
    return studio !== null;
}

/** Displayed linear color of the ground near the scene or, without a ground, of the horizon. */
export function groundColor(lighting: Lighting, axis: UpAxis): Vec3 {
    const { ground, horizon, studio, skylight, sunlight, toSun } = lighting;
    const ambient = studio?.ambientCube[2 * axis] ?? skylight;
    const sine = Math.max(0, toSun[axis]);
    return horizon.map((light, channel) => {
        const lit = ground && at(ground, channel) * (at(ambient, channel) + sine * at(sunlight, channel));
        return displayedOf(lit ?? light, lighting);
    }) as Vec3;
}

/** The displayed linear value of a light, as in the shaders. */
export function displayedOf(light: number, { exposure, tone }: Pick<Lighting, "exposure" | "tone">): number {
    const x = light * exposure;
    if (tone === 1) return x / (1 + x);
    return Math.min(1, tone === 2 ? (x * (2.51 * x + 0.03)) / (x * (2.43 * x + 0.59) + 0.14) : x);
}

/** An sRGB color of CSS. */
export function cssColor(linear: readonly number[]): string {
    const encode = (value: number) => (value <= 0.0031308 ? 12.92 * value : 1.055 * value ** (1 / 2.4) - 0.055);
    return `rgb(${linear.map((value) => Math.round(255 * encode(value))).join(" ")})`;
}

/** Largest value of f16, because the inverse of a tone curve may be infinite. */
const LARGEST_LIGHT = 65504;

/** The light that the tone curve maps to a displayed linear value from 0 to 1. */
export function lightOf(displayed: number, { exposure, tone }: Pick<Lighting, "exposure" | "tone">): number {
    return Math.min(inverseTone(displayed, tone) / exposure, LARGEST_LIGHT);
}

function inverseTone(displayed: number, tone: number): number {
    if (tone === 1) return displayed / (1 - displayed);
    if (tone !== 2) return displayed;
    // The positive root of x (2.51 x + 0.03) = displayed (x (2.43 x + 0.59) + 0.14).
    const [a, b, c] = [2.51 - 2.43 * displayed, 0.03 - 0.59 * displayed, -0.14 * displayed];
    return (-b + Math.sqrt(b * b - 4 * a * c)) / (2 * a);
}

/** x, y and z axes of the sun's shadow map. z points to the sun. */
export function lightAxes(toSun: Vec3, up: Vec3): [Vec3, Vec3, Vec3] {
    let x = cross(up, toSun);
    if (norm(x) < 1e-6) x = cross(Math.abs(toSun[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0], toSun);
    x = normalized(x);
    return [x, cross(toSun, x), toSun];
}

/** A box along the axes of the shadow map. */
export interface LightBox {
    axes: [Vec3, Vec3, Vec3];
    center: Vec3;
    /** Side of the square that the map covers. */
    side: number;
    /** Extent towards the sun. */
    depth: number;
}

/** The box that encloses the spheres, with a side and a center that change in steps, so that shadows do not flicker. */
export function fitLightBox(
    spheres: readonly { center: Vec3; radius: number }[],
    axes: [Vec3, Vec3, Vec3],
    texels: number,
): LightBox {
    const min: Vec3 = [Infinity, Infinity, Infinity];
    const max: Vec3 = [-Infinity, -Infinity, -Infinity];
    for (const { center, radius } of spheres) {
        axes.forEach((direction, axis) => {
            const value = dot(center, direction);
            min[axis] = Math.min(min[axis] as number, value - radius);
            max[axis] = Math.max(max[axis] as number, value + radius);
        });
    }
    const widest = Math.max(max[0] - min[0], max[1] - min[1], 1e-6);
    const side = 2 ** (Math.ceil(8 * Math.log2(1.02 * widest)) / 8);
    const texel = side / texels;
    const center = min.map((low, axis) => {
        const middle = (low + (max[axis] as number)) / 2;
        return axis < 2 ? Math.round(middle / texel) * texel : middle;
    }) as Vec3;
    return { axes, center, side, depth: 1.02 * Math.max(max[2] - min[2], 1e-6) };
}
