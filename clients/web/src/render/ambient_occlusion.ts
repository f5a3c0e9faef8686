/** Ambient occlusion: finds the surface at each texel, computes its visibility, and filters the noise. */

import * as THREE from "three";
import { AMBIENT_CENTER, AMBIENT_FILTER_FRAGMENT, AMBIENT_OCCLUSION_FRAGMENT, AMBIENT_SCALE } from "./ambient_shaders";
import { FullscreenPass } from "./fullscreen_pass";
import type { Uniforms } from "./surfaces";

/**
 * Slices (planes through the view ray) per texel, and surface points on each side of a slice: on a GPU, and on the CPU.
 * The server has as many.
 */
const SAMPLING = { SLICES: 2, STEPS: 4 };
const SOFTWARE_SAMPLING = { SLICES: 1, STEPS: 4 };

export class AmbientOcclusion {
    /** Uniforms of the lookup. */
    readonly uniforms: Uniforms;
    private readonly extent = new THREE.Vector2();
    private readonly surface = createTarget(THREE.RGIntegerFormat, THREE.UnsignedIntType, "RG32UI", true);
    private readonly noisyVisibility = createTarget(THREE.RGFormat, THREE.FloatType, "RG32F", false);
    private readonly visibility = createTarget(THREE.RGFormat, THREE.FloatType, "RG32F", false);
    private readonly occlusion: FullscreenPass;
    private readonly filter: FullscreenPass;

    /** @param radius In scene units. */
    constructor(
        private readonly renderer: THREE.WebGLRenderer,
        isSoftware: boolean,
        radius: number,
    ) {
        this.uniforms = {
            ambient_visibility: { value: this.visibility.texture },
            ambient_extent: { value: this.extent },
            ambient_radius: { value: radius },
        };
        const defines = isSoftware ? SOFTWARE_SAMPLING : SAMPLING;
        const surface = this.surface.texture;
        this.occlusion = new FullscreenPass(AMBIENT_OCCLUSION_FRAGMENT, { surface }, { defines: { ...defines } });
        this.filter = new FullscreenPass(AMBIENT_FILTER_FRAGMENT, {
            surface,
            noisy_visibility: this.noisyVisibility.texture,
        });
    }

    /** @param light Uniforms that all surfaces share. */
    connect(light: Uniforms, hasGround: boolean): void {
        for (const pass of [this.occlusion, this.filter]) {
            Object.assign(pass.mesh.material.uniforms, light);
            pass.define("GROUND", hasGround);
        }
    }

    /** @param surfaces The surfaces that occlude. */
    render(surfaces: THREE.Scene, camera: THREE.PerspectiveCamera): void {
        const { renderer, extent } = this;
        const size = renderer.getDrawingBufferSize(new THREE.Vector2());
        extent.copy(size).divideScalar(AMBIENT_SCALE);
        for (const target of this.targets) target.setSize(Math.ceil(extent.x), Math.ceil(extent.y));
        const projection = camera.projectionMatrix.clone();
        camera.projectionMatrix.premultiply(texelsFromPixels(size, this.surface));
        const clearColor = renderer.getClearColor(new THREE.Color());
        const clearAlpha = renderer.getClearAlpha();
        renderer.setClearColor(0, 0);
        renderer.setRenderTarget(this.surface);
        renderer.render(surfaces, camera);
        renderer.setClearColor(clearColor, clearAlpha);
        camera.projectionMatrix.copy(projection);
        this.occlusion.render(renderer, this.noisyVisibility);
        this.filter.render(renderer, this.visibility);
    }

    dispose(): void {
        for (const target of this.targets) target.dispose();
        this.occlusion.dispose();
        this.filter.dispose();
    }

    private get targets(): THREE.WebGLRenderTarget[] {
        return [this.surface, this.noisyVisibility, this.visibility];
    }
}

function createTarget(
    format: THREE.PixelFormat,
    type: THREE.TextureDataType,
    internalFormat: THREE.PixelFormatGPU,
    depthBuffer: boolean,
): THREE.WebGLRenderTarget {
    return new THREE.WebGLRenderTarget(1, 1, {
        format,
        type,
        internalFormat,
        depthBuffer,
        minFilter: THREE.NearestFilter,
        magFilter: THREE.NearestFilter,
    });
}

/**
 * Maps clip coordinates of the canvas to those of an image with one texel per AMBIENT_SCALE x AMBIENT_SCALE pixels. The
 * center of a texel is the center of its lower left pixel.
 */
export function texelsFromPixels(
    pixels: { x: number; y: number },
    texels: { width: number; height: number },
): THREE.Matrix4 {
    const scaleX = pixels.x / AMBIENT_SCALE / texels.width;
    const scaleY = pixels.y / AMBIENT_SCALE / texels.height;
    const shiftX = scaleX - 1 + (1 - 2 * AMBIENT_CENTER) / texels.width;
    const shiftY = scaleY - 1 + (1 - 2 * AMBIENT_CENTER) / texels.height;
    return new THREE.Matrix4().set(scaleX, 0, 0, shiftX, 0, scaleY, 0, shiftY, 0, 0, 1, 0, 0, 0, 0, 1);
}
