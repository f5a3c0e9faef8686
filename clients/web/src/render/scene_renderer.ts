/** Draws one scene with three.js: deformation, shadow map, ambient occlusion, surfaces, sky and ground. */

import * as THREE from "three";
import { norm, subtract, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import type { SceneArrays } from "../scene/arrays";
import { type DomainSphere, domainSpheres, linearNorm, restSphere, type Sphere } from "../scene/bounds";
import type { SceneDescription } from "../scene/description";
import { at } from "../scene/numbers";
import { errorBound } from "../scene/packed_modes";
import type { SceneState } from "../scene/state";
import { AmbientOcclusion } from "./ambient_occlusion";
import { Deformer, type DomainDisplay } from "./deformer";
import { FullscreenPass } from "./fullscreen_pass";
import {
    fitLightBox,
    groundColor,
    keepsBackground,
    type Lighting,
    lightAxes,
    lightingOf,
    lightOf,
    unitVector,
    upAxis,
} from "./lighting";
import { BACKGROUND_FRAGMENT, PLAIN_FRAGMENT } from "./shaders";
import { Surfaces, type Uniforms } from "./surfaces";
import { Transparency } from "./transparency";

/** Side of the shadow map in texels on a GPU, and on the CPU. */
const SHADOW_SIZE = 2048;
const SOFTWARE_SHADOW_SIZE = 512;

/** The render origin moves to the eye if it is this far away, in diagonals of the scene. This keeps f32 precise. */
const ORIGIN_DISTANCE = 64;

export type ColorChoice = { kind: "shaded" } | { kind: "displacement" } | { kind: "mode"; mode: number };

/** The sky and ground of the scene, or a plain color for pictures in documents. */
export type BackgroundChoice = "scene" | "gray" | "white";

export interface RenderOptions {
    shadows: boolean;
    edges: boolean;
    color: ColorChoice;
    background: BackgroundChoice;
}

/** Linear gray behind color maps unless the background stays, equal to the server's, and linear white. */
const PLAIN_GRAY = 0.87;
const WHITE = 1;

export class SceneRenderer {
    readonly deformer: Deformer;
    readonly lighting: Lighting;
    readonly diagonal: number;
    private readonly shadowSize: number;
    private readonly surfaces: Surfaces;
    private readonly transparency: Transparency;
    /** Null if the scene has no ambient occlusion. */
    private readonly ambientOcclusion: AmbientOcclusion | null;
    private readonly background: FullscreenPass;
    private readonly plain: FullscreenPass;
    private readonly shadowTarget: THREE.WebGLRenderTarget;
    private readonly light: Uniforms;
    private readonly shadowUniforms: Uniforms = { clip_from_world: { value: new THREE.Matrix4() } };
    /** The tone curve of blended pictures. */
    private readonly tone: Uniforms = { exposure: { value: 1 }, tone: { value: 0 } };
    private readonly restSpheres: Sphere[];
    private spheres: DomainSphere[] = [];
    private state: SceneState | null = null;
    private origin: Vec3 = [0, 0, 0];
    private options: RenderOptions = { shadows: true, edges: false, color: { kind: "shaded" }, background: "scene" };
    private display: DomainDisplay = { hidden: new Set(), highlighted: null };
    private needsShadow = true;
    private needsDeformation = true;

    constructor(
        private readonly renderer: THREE.WebGLRenderer,
        readonly scene: SceneDescription,
        arrays: SceneArrays,
        isSoftware: boolean,
    ) {
        this.shadowSize = isSoftware ? SOFTWARE_SHADOW_SIZE : SHADOW_SIZE;
        this.lighting = lightingOf(scene);
        const bounds = scene.info.bounds;
        this.diagonal = norm([0, 1, 2].map((axis) => at(bounds, 3 + axis) - at(bounds, axis)) as Vec3) || 1;
        this.restSpheres = arrays.shapes.map(restSphere);
        this.deformer = new Deformer(renderer, scene, arrays);
        this.shadowTarget = createShadowTarget(this.shadowSize);
        const radius = this.lighting.ambientOcclusionRadius * this.diagonal;
        this.ambientOcclusion = radius > 0 ? new AmbientOcclusion(renderer, isSoftware, radius) : null;
        this.light = this.createLight();
        this.ambientOcclusion?.connect(this.light, this.lighting.ground !== null);
        const quality = { anisotropy: renderer.capabilities.getMaxAnisotropy(), blendsLevels: !isSoftware };
        this.transparency = new Transparency(renderer, isSoftware, this.tone);
        const { uniforms } = this.transparency;
        this.surfaces = new Surfaces(scene, arrays, this.deformer, this.light, uniforms, this.shadowUniforms, quality);
        this.background = this.createBackground();
        this.background.define("SINGLE_LOOKUP", isSoftware);
        this.plain = new FullscreenPass(PLAIN_FRAGMENT, {
            plain: new THREE.Vector3(PLAIN_GRAY, PLAIN_GRAY, PLAIN_GRAY),
        });
        this.plain.mesh.visible = false;
        for (const pass of this.backgrounds) {
            pass.mesh.renderOrder = -1;
            this.surfaces.colorScene.add(pass.mesh);
        }
        this.setOptions(this.options);
    }

    setOptions(options: RenderOptions): void {
        this.options = { ...options, shadows: options.shadows && this.lighting.shadows };
        const isMap = options.color.kind !== "shaded";
        this.deformer.showMode(options.color.kind === "mode" ? options.color.mode : null);
        this.define("SHADOWS", this.options.shadows);
        this.define("STUDIO", this.lighting.studio !== null);
        const isPlain = options.background !== "scene" || (isMap && !keepsBackground(this.lighting));
        this.surfaces.define("AMBIENT_OCCLUSION", this.ambientOcclusion !== null && !isMap);
        this.background.define("AMBIENT_OCCLUSION", this.ambientOcclusion !== null);
        this.background.define("COLOR_MAP", isMap);
        this.surfaces.setEdges(options.edges);
        if (!isMap) this.surfaces.setColorMode({ kind: "shaded" });
        // `Transparency` blends light and converts it to pixel colors.
        this.define("LINEAR_OUTPUT", this.needsBlending);
        this.plain.define("LINEAR_OUTPUT", this.needsBlending);
        if (!this.needsBlending) this.transparency.release();
        // Color maps have no tone curve.
        this.setUniform(this.tone, "exposure", isMap ? 1 : this.lighting.exposure);
        this.setUniform(this.tone, "tone", isMap ? 0 : this.lighting.tone);
        this.background.mesh.visible = !isPlain;
        this.plain.mesh.visible = isPlain;
        this.plain.setUniform("plain", this.plainLight());
        if (this.state) this.update(this.state);
    }

    /** Defines or undefines a macro of the shaders of surfaces and of the background. */
    private define(name: string, isDefined: boolean): void {
        this.surfaces.define(name, isDefined);
        this.background.define(name, isDefined);
    }

    /** Output of the plain background: the displayed color, or the light that the tone curve maps to it. */
    private plainLight(): THREE.Vector3 {
        const displayed = this.options.background === "white" ? WHITE : PLAIN_GRAY;
        const isMap = this.options.color.kind !== "shaded";
        const light = this.needsBlending && !isMap ? lightOf(displayed, this.lighting) : displayed;
        return new THREE.Vector3(light, light, light);
    }

    setDisplay(display: DomainDisplay): void {
        this.display = display;
        if (this.state) this.update(this.state);
    }

    /** Sets the state of the next frame. If several states arrive between two frames, only the last one is deformed. */
    update(state: SceneState): void {
        this.state = state;
        this.needsDeformation = true;
    }

    /** @param end The value at the bright end of the color map, in meters, or in meters per unit of q. */
    setColorScale(end: number): void {
        if (this.options.color.kind === "shaded") return;
        this.surfaces.setColorMode({ kind: "map", largest: end / this.scene.info.unit });
    }

    private deform(state: SceneState): void {
        this.needsDeformation = false;
        this.deformer.deform(state, this.origin, this.display);
        this.spheres = domainSpheres(state, this.restSpheres, this.deformer.packed);
        this.needsShadow = true;
    }

    /** Displayed linear color of the background near the lower edge of the view. */
    get backgroundColor(): Vec3 {
        const plain = this.options.background === "white" ? WHITE : PLAIN_GRAY;
        return this.plain.mesh.visible ? [plain, plain, plain] : groundColor(this.lighting, upAxis(this.scene));
    }

    /** Near and far plane of a camera, so that they enclose all domains. */
    depthRange(camera: THREE.PerspectiveCamera): { near: number; far: number } {
        const view = camera.matrixWorldInverse.elements;
        let near = Infinity;
        let far = 0;
        for (const { center, radius } of this.spheres) {
            const depth = -(
                at(view, 2) * center[0] +
                at(view, 6) * center[1] +
                at(view, 10) * center[2] +
                at(view, 14)
            );
            near = Math.min(near, depth - radius);
            far = Math.max(far, depth + radius);
        }
        if (!(far > 0)) return { near: 0.1, far: 10 };
        return { near: Math.max(0.98 * near, 2e-4 * far), far: 1.02 * far };
    }

    render(camera: THREE.PerspectiveCamera): void {
        this.prepare(camera);
        const { colorScene, blendScene, blendMaterials, ambientScene } = this.surfaces;
        if (this.options.color.kind === "shaded" || this.background.mesh.visible) {
            if (this.options.shadows && this.needsShadow) this.renderShadow();
            this.ambientOcclusion?.render(ambientScene, camera);
        }
        if (this.needsBlending) {
            this.transparency.render({ opaque: colorScene, blended: blendScene, blendMaterials }, camera);
            return;
        }
        this.renderer.setRenderTarget(null);
        this.renderer.render(colorScene, camera);
    }

    /** Whether surfaces or lines are blended. Other scenes are drawn to the canvas directly. */
    private get needsBlending(): boolean {
        return this.options.edges || this.surfaces.blendMaterials.length > 0;
    }

    private get backgrounds(): FullscreenPass[] {
        return [this.background, this.plain];
    }

    /** Index of the domain at each pixel, top row first; 0xffffffff where there is no surface. It waits for the GPU. */
    domainIds(camera: THREE.PerspectiveCamera, width: number, height: number): Uint32Array {
        this.prepare(camera);
        const target = new THREE.WebGLRenderTarget(width, height, {
            format: THREE.RGBAIntegerFormat,
            type: THREE.UnsignedIntType,
            internalFormat: "RGBA32UI",
            minFilter: THREE.NearestFilter,
            magFilter: THREE.NearestFilter,
        });
        const clearColor = this.renderer.getClearColor(new THREE.Color());
        const clearAlpha = this.renderer.getClearAlpha();
        this.renderer.setRenderTarget(target);
        this.renderer.setClearColor(0, 0);
        this.renderer.clear();
        this.renderer.render(this.surfaces.domainScene, camera);
        const texels = new Uint32Array(4 * width * height);
        this.renderer.readRenderTargetPixels(target, 0, 0, width, height, texels);
        this.renderer.setRenderTarget(null);
        this.renderer.setClearColor(clearColor, clearAlpha);
        target.dispose();
        const ids = new Uint32Array(width * height);
        for (let y = 0; y < height; y++) {
            for (let x = 0; x < width; x++) ids[y * width + x] = at(texels, 4 * ((height - 1 - y) * width + x)) - 1;
        }
        return ids;
    }

    /** Deformed vertices as the GPU has computed them, in scene units relative to `origin`. For tests. */
    readVertices(): { positions: Float32Array; firstVertex: number[]; origin: Vec3 } {
        return {
            positions: this.deformer.readPositions(),
            firstVertex: this.deformer.firstVertex,
            origin: this.origin,
        };
    }

    /** Upper bound in meters of the position error of any vertex that the storage of U in 16 bits causes. */
    errorBound(): number {
        const { state, scene } = this;
        if (!state) return 0;
        let largest = 0;
        for (const domain of scene.domains) {
            const packed = this.deformer.packed[domain.shape];
            if (!packed) continue;
            const error = errorBound(packed, state.qOf(domain.domain));
            largest = Math.max(largest, error * linearNorm(state.transforms, TRANSFORM_SIZE * domain.domain));
        }
        return largest * scene.info.unit;
    }

    dispose(): void {
        this.deformer.dispose();
        this.surfaces.dispose();
        this.transparency.dispose();
        this.ambientOcclusion?.dispose();
        this.background.dispose();
        this.plain.dispose();
        this.shadowTarget.depthTexture?.dispose();
        this.shadowTarget.dispose();
    }

    private prepare(camera: THREE.PerspectiveCamera): void {
        camera.updateMatrixWorld();
        const eye = camera.position.toArray() as Vec3;
        if (this.state && norm(subtract(eye, this.origin)) > ORIGIN_DISTANCE * this.diagonal) {
            this.origin = eye.map(Math.round) as Vec3;
            this.needsDeformation = true;
        }
        if (this.state && this.needsDeformation) this.deform(this.state);
        const { near, far } = this.depthRange(camera);
        camera.near = near;
        camera.far = far;
        camera.updateProjectionMatrix();
        this.surfaces.moveTo(this.origin);
        this.setLight("eye", new THREE.Vector3(...subtract(eye, this.origin)));
        this.prepareBackground(camera);
    }

    private prepareBackground(camera: THREE.PerspectiveCamera): void {
        const axis = upAxis(this.scene);
        const bounds = this.scene.info.bounds;
        const center = [0, 1, 2].map((i) => (at(bounds, i) + at(bounds, 3 + i)) / 2) as Vec3;
        const offset = subtract(camera.position.toArray() as Vec3, center);
        offset[axis] = 0;
        const fade = 3.5 * Math.max(this.diagonal, norm(offset));
        const relative = subtract(center, this.origin);
        const color = this.lighting.ground ?? [0, 0, 0];
        this.background.setUniform("ground", new THREE.Vector4(...color, fade));
        const height = at(bounds, axis) - at(this.origin, axis);
        this.setLight("ground_center", new THREE.Vector4(...relative, height));
        this.setLight("world_from_ndc", worldFromNdc(camera));
    }

    private setLight(name: string, value: unknown): void {
        this.setUniform(this.light, name, value);
    }

    private setUniform(uniforms: Uniforms, name: string, value: unknown): void {
        const uniform = uniforms[name];
        if (uniform) uniform.value = value;
    }

    private createLight(): Uniforms {
        const { lighting } = this;
        const vector = (value: Vec3) => ({ value: new THREE.Vector3(...value) });
        const { studio } = lighting;
        return {
            world_from_ndc: { value: new THREE.Matrix4() },
            eye: { value: new THREE.Vector3() },
            up: vector(unitVector(upAxis(this.scene))),
            ground_center: { value: new THREE.Vector4() },
            to_sun: vector(lighting.toSun),
            sunlight: vector(lighting.sunlight),
            skylight: vector(lighting.skylight),
            exposure: { value: lighting.exposure },
            tone: { value: lighting.tone },
            shadow_map: { value: this.shadowTarget.depthTexture },
            shadow_from_world: { value: new THREE.Matrix4() },
            shadow_texel: { value: 0 },
            shadow_bias: { value: 0 },
            map_scale: { value: 0 },
            ...(studio && {
                ambient_cube: { value: studio.ambientCube.map((color) => new THREE.Vector3(...color)) },
                fill: vector(studio.fill),
            }),
            ...this.ambientOcclusion?.uniforms,
        };
    }

    private createBackground(): FullscreenPass {
        const vector = (value: Vec3) => new THREE.Vector3(...value);
        const pass = new FullscreenPass(BACKGROUND_FRAGMENT, {
            zenith: vector(this.lighting.zenith),
            horizon: vector(this.lighting.horizon),
            ground: new THREE.Vector4(),
        });
        Object.assign(pass.mesh.material.uniforms, this.light);
        pass.define("GROUND", this.lighting.ground !== null);
        return pass;
    }

    private renderShadow(): void {
        this.needsShadow = false;
        const axes = lightAxes(this.lighting.toSun, unitVector(upAxis(this.scene)));
        const spheres = this.spheres
            .filter((_, domain) => !this.display.hidden.has(domain))
            .map(({ center, shadowRadius }) => ({ center: subtract(center, this.origin), radius: shadowRadius }));
        if (spheres.length === 0) spheres.push({ center: [0, 0, 0], radius: this.diagonal });
        const box = fitLightBox(spheres, axes, this.shadowSize);
        const [x, y, z] = box.axes;
        const row = (axis: Vec3, center: number, extent: number) =>
            [...axis.map((component) => (2 * component) / extent), (-2 * center) / extent] as [
                number,
                number,
                number,
                number,
            ];
        const clip = new THREE.Matrix4().set(
            ...row(x, box.center[0], box.side),
            ...row(y, box.center[1], box.side),
            // The depth increases away from the sun.
            ...(row(z, box.center[2], box.depth).map((value) => -value) as [number, number, number, number]),
            ...([0, 0, 0, 1] as const),
        );
        const half = new THREE.Matrix4().set(0.5, 0, 0, 0.5, 0, 0.5, 0, 0.5, 0, 0, 0.5, 0.5, 0, 0, 0, 1);
        const texel = box.side / this.shadowSize;
        if (this.shadowUniforms["clip_from_world"]) this.shadowUniforms["clip_from_world"].value = clip;
        this.setLight("shadow_from_world", half.multiply(clip));
        this.setLight("shadow_texel", texel);
        this.setLight("shadow_bias", (0.75 * texel) / box.depth);
        this.renderer.setRenderTarget(this.shadowTarget);
        this.renderer.clear();
        this.renderer.render(this.surfaces.shadowScene, new THREE.Camera());
        this.renderer.setRenderTarget(null);
    }
}

function createShadowTarget(size: number): THREE.WebGLRenderTarget {
    const depthTexture = new THREE.DepthTexture(size, size, THREE.UnsignedIntType);
    depthTexture.compareFunction = THREE.LessEqualCompare;
    depthTexture.minFilter = THREE.LinearFilter;
    depthTexture.magFilter = THREE.LinearFilter;
    return new THREE.WebGLRenderTarget(size, size, { depthTexture, generateMipmaps: false });
}

/** From (x, y, 1) in normalized device coordinates to the direction of a view ray. */
function worldFromNdc(camera: THREE.PerspectiveCamera): THREE.Matrix4 {
    const projection = camera.projectionMatrix.elements;
    const rays = new THREE.Matrix4().set(
        1 / at(projection, 0),
        0,
        0,
        0,
        0,
        1 / at(projection, 5),
        0,
        0,
        0,
        0,
        -1,
        0,
        0,
        0,
        0,
        1,
    );
    return new THREE.Matrix4().extractRotation(camera.matrixWorld).multiply(rays);
}
