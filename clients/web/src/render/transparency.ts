/** Order-independent transparency in linear light, as the server blends. */

import * as THREE from "three";
import { FullscreenPass } from "./fullscreen_pass";
import { BLEND_FRAGMENT, COPY_FRAGMENT, ENCODE_FRAGMENT } from "./shaders";
import type { Uniforms } from "./surfaces";

/** Layers that are blended in order at each sample, on a GPU and on the CPU. The rest is ordered by material. */
const LAYERS = 8;
const SOFTWARE_LAYERS = 4;

/** Positions of samples in pixels, relative to the center: those of 4x multisampling in graphics drivers. */
const SAMPLES: readonly (readonly [number, number])[] = [
    [-0.125, -0.375],
    [0.375, -0.125],
    [-0.375, 0.125],
    [0.125, 0.375],
];

/** Scenes and materials that `Transparency` draws. All of them write light (see LINEAR_OUTPUT in the shaders). */
export interface BlendedScene {
    opaque: THREE.Scene;
    blended: THREE.Scene;
    blendMaterials: readonly THREE.RawShaderMaterial[];
}

/**
 * Draws a scene to the canvas with depth peeling (Everitt 2001): pass k draws, at each sample, the nearest blended
 * fragment behind that of pass k - 1. WebGL cannot read the depths of multisampled images, so each sample of a pixel is
 * one picture, whose camera is moved by a part of a pixel. The pixel is the mean of the samples after the tone curve.
 */
export class Transparency {
    /** Uniforms of blended surfaces. */
    readonly uniforms: Uniforms = {
        layer: { value: 0 },
        opaque_depth: { value: null },
        nearer_depth: { value: null },
    };
    private readonly samples: readonly (readonly [number, number])[];
    private readonly layerCount: number;
    private targets: Targets | null = null;
    /** Adds a layer behind those that have been drawn. */
    private readonly under = new FullscreenPass(
        COPY_FRAGMENT,
        { source: null },
        blending(THREE.OneMinusDstAlphaFactor, THREE.OneFactor),
    );
    private readonly accumulate: FullscreenPass;
    private readonly encode = new FullscreenPass(ENCODE_FRAGMENT, { source: null });

    /** @param tone Uniforms of the tone curve: exposure and tone. */
    constructor(
        private readonly renderer: THREE.WebGLRenderer,
        isSoftware: boolean,
        tone: Uniforms,
    ) {
        // Without multisampling, as the canvas: see `Viewport`.
        this.samples = isSoftware ? [[0, 0]] : SAMPLES;
        this.layerCount = isSoftware ? SOFTWARE_LAYERS : LAYERS;
        this.accumulate = new FullscreenPass(
            BLEND_FRAGMENT,
            { opaque: null, layers: null, weight: 1 / this.samples.length },
            blending(THREE.OneFactor, THREE.OneFactor),
        );
        Object.assign(this.accumulate.mesh.material.uniforms, tone);
    }

    render(scene: BlendedScene, camera: THREE.PerspectiveCamera): void {
        const { renderer } = this;
        const size = renderer.getDrawingBufferSize(new THREE.Vector2());
        const targets = this.targetsOf(size);
        const clearColor = renderer.getClearColor(new THREE.Color());
        const clearAlpha = renderer.getClearAlpha();
        renderer.setClearColor(0, 0);
        renderer.autoClear = false;
        this.clear(targets.sum);
        const projection = camera.projectionMatrix.clone();
        for (const [x, y] of this.samples) {
            camera.projectionMatrix.copy(projection);
            const elements = camera.projectionMatrix.elements;
            // The view looks along -z, so that x moves the picture by -x pixels.
            elements[8] = (projection.elements[8] ?? 0) + (2 * x) / size.x;
            elements[9] = (projection.elements[9] ?? 0) + (2 * y) / size.y;
            this.renderSample(scene, camera, targets);
        }
        camera.projectionMatrix.copy(projection);
        this.encode.setUniform("source", targets.sum.texture);
        this.encode.render(renderer, null);
        renderer.autoClear = true;
        renderer.setClearColor(clearColor, clearAlpha);
    }

    /** Frees the images. The next frame creates them again. */
    release(): void {
        if (!this.targets) return;
        for (const target of [this.targets.opaque, this.targets.front, this.targets.sum, ...this.targets.layers]) {
            target.depthTexture?.dispose();
            target.dispose();
        }
        this.targets = null;
    }

    dispose(): void {
        this.release();
        for (const pass of [this.under, this.accumulate, this.encode]) pass.dispose();
    }

    private renderSample(scene: BlendedScene, camera: THREE.PerspectiveCamera, targets: Targets): void {
        const { renderer } = this;
        this.clear(targets.opaque);
        renderer.render(scene.opaque, camera);
        this.clear(targets.front);
        this.setUniform("opaque_depth", targets.opaque.depthTexture);
        const layers = scene.blendMaterials.length > 0 ? this.layerCount : 0;
        for (let layer = 0; layer < layers; layer++)
            this.renderLayer(scene, camera, targets, layer, layer === layers - 1);
        this.accumulate.setUniform("opaque", targets.opaque.texture);
        this.accumulate.setUniform("layers", targets.front.texture);
        this.accumulate.render(renderer, targets.sum);
    }

    /** @param isRest Whether the layer has all fragments that are left, blended in the order in which they are drawn. */
    private renderLayer(
        scene: BlendedScene,
        camera: THREE.PerspectiveCamera,
        targets: Targets,
        layer: number,
        isRest: boolean,
    ): void {
        const target = targets.layers[layer % 2] as THREE.WebGLRenderTarget;
        const nearer = targets.layers[(layer + 1) % 2] as THREE.WebGLRenderTarget;
        this.setUniform("layer", layer);
        this.setUniform("nearer_depth", nearer.depthTexture);
        const over = isRest ? blending(THREE.OneFactor, THREE.OneMinusSrcAlphaFactor) : { blending: THREE.NoBlending };
        for (const material of scene.blendMaterials) {
            material.setValues({ ...over, depthTest: !isRest, depthWrite: !isRest });
        }
        this.clear(target);
        this.renderer.render(scene.blended, camera);
        this.under.setUniform("source", target.texture);
        this.under.render(this.renderer, targets.front);
    }

    private setUniform(name: string, value: unknown): void {
        const uniform = this.uniforms[name];
        if (uniform) uniform.value = value;
    }

    private clear(target: THREE.WebGLRenderTarget): void {
        this.renderer.setRenderTarget(target);
        this.renderer.clear();
    }

    private targetsOf(size: THREE.Vector2): Targets {
        if (this.targets?.sum.width === size.x && this.targets.sum.height === size.y) return this.targets;
        this.release();
        const create = (hasDepth: boolean) => createTarget(size.x, size.y, hasDepth);
        this.targets = {
            opaque: create(true),
            layers: [create(true), create(true)],
            front: create(false),
            sum: create(false),
        };
        return this.targets;
    }
}

/** Images of the size of the canvas, in linear light. */
interface Targets {
    opaque: THREE.WebGLRenderTarget;
    /** Two layers with their depths, which alternate. Colors are premultiplied. */
    layers: [THREE.WebGLRenderTarget, THREE.WebGLRenderTarget];
    /** All layers drawn so far, premultiplied. */
    front: THREE.WebGLRenderTarget;
    /** Mean of the samples after the tone curve. */
    sum: THREE.WebGLRenderTarget;
}

/** RGBA16F can be drawn to and blended wherever the viewer runs: see `probeWebGl`. Depths in f32 equal gl_FragCoord.z. */
function createTarget(width: number, height: number, hasDepth: boolean): THREE.WebGLRenderTarget {
    return new THREE.WebGLRenderTarget(width, height, {
        type: THREE.HalfFloatType,
        minFilter: THREE.NearestFilter,
        magFilter: THREE.NearestFilter,
        depthBuffer: hasDepth,
        ...(hasDepth ? { depthTexture: new THREE.DepthTexture(width, height, THREE.FloatType) } : {}),
    });
}

function blending(
    source: THREE.BlendingSrcFactor,
    destination: THREE.BlendingDstFactor,
): THREE.ShaderMaterialParameters {
    return {
        blending: THREE.CustomBlending,
        blendEquation: THREE.AddEquation,
        blendSrc: source,
        blendDst: destination,
    };
}
