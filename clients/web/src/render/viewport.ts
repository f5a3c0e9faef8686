/** The canvas of the viewer, and the loop that draws it when something has changed. */

import * as THREE from "three";
import { OrbitCamera } from "./camera";
import type { SceneRenderer } from "./scene_renderer";

const SOFTWARE_RENDERER = /swiftshader|llvmpipe|softpipe|software|basic render/i;

export class Viewport {
    readonly camera: OrbitCamera;
    readonly gl: THREE.WebGLRenderer | null;
    /** The name that WebGL reports, or the reason why there is no WebGL. */
    readonly rendererName: string;
    readonly isSoftware: boolean;
    private sceneRenderer: SceneRenderer | null = null;
    private needsFrame = true;
    /** Whether frames are drawn although nothing has changed. */
    drawsAlways = false;
    /** When the frames of the last second were drawn, in milliseconds of `performance.now()`. */
    private frameTimes: number[] = [];
    private contextLost = false;
    /** Called before each frame that is drawn. */
    onFrame: () => void = () => {};
    /** Called when a frame is drawn, while its pixels can be read. For tests. */
    onDrawn: () => void = () => {};
    /** Called when the size of the canvas in pixels has changed. */
    onResize: () => void = () => {};
    onContextRestored: () => void = () => {};

    constructor(
        private readonly container: HTMLElement,
        readonly canvas: HTMLCanvasElement,
    ) {
        this.camera = new OrbitCamera(container);
        const probe = probeWebGl();
        this.rendererName = probe.name;
        this.isSoftware = SOFTWARE_RENDERER.test(probe.name);
        this.gl = probe.isUsable ? this.createRenderer() : null;
        new ResizeObserver(() => this.resize()).observe(container);
        this.resize();
        requestAnimationFrame(() => this.loop());
    }

    /** Width and height of pictures in pixels of the device. */
    get pixelSize(): [number, number] {
        const ratio = this.pixelRatio;
        return [
            Math.max(1, Math.round(this.container.clientWidth * ratio)),
            Math.max(1, Math.round(this.container.clientHeight * ratio)),
        ];
    }

    get pixelRatio(): number {
        return this.isSoftware ? 1 : Math.min(window.devicePixelRatio, 2);
    }

    /** Frames drawn in the last second. */
    get framesPerSecond(): number {
        const now = performance.now();
        this.frameTimes = this.frameTimes.filter((time) => now - time < 1000);
        return this.frameTimes.length;
    }

    setScene(renderer: SceneRenderer | null): void {
        this.sceneRenderer?.dispose();
        this.sceneRenderer = renderer;
        if (!renderer) this.gl?.clear();
        this.invalidate();
    }

    /** Requests a frame. */
    invalidate(): void {
        this.needsFrame = true;
    }

    private createRenderer(): THREE.WebGLRenderer {
        // Multisampling takes most of the time of a software renderer.
        const gl = new THREE.WebGLRenderer({
            canvas: this.canvas,
            antialias: !this.isSoftware,
            powerPreference: "high-performance",
        });
        gl.setPixelRatio(1);
        gl.autoClear = true;
        gl.setClearColor(0x8fb0d8, 1);
        this.canvas.addEventListener("webglcontextlost", () => {
            this.contextLost = true;
        });
        this.canvas.addEventListener("webglcontextrestored", () => {
            this.contextLost = false;
            this.onContextRestored();
        });
        return gl;
    }

    private resize(): void {
        const [width, height] = this.pixelSize;
        this.camera.resize();
        this.gl?.setSize(width, height, false);
        this.onResize();
        this.invalidate();
    }

    private loop(): void {
        requestAnimationFrame(() => this.loop());
        if (this.needsFrame || this.drawsAlways) this.draw();
    }

    /** Draws a frame. Its pixels can be read until the current task ends. */
    draw(): void {
        this.needsFrame = false;
        this.onFrame();
        if (!this.sceneRenderer || this.contextLost) return;
        this.sceneRenderer.render(this.camera.camera);
        this.frameTimes.push(performance.now());
        this.onDrawn();
    }
}

interface WebGlProbe {
    name: string;
    isUsable: boolean;
}

/** Whether WebGL2 can render to f32 textures, and the name of the renderer. */
function probeWebGl(): WebGlProbe {
    const gl = document.createElement("canvas").getContext("webgl2");
    if (!gl) return { name: "no WebGL2", isUsable: false };
    const info = gl.getExtension("WEBGL_debug_renderer_info");
    const name = String(gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
    const isUsable = gl.getExtension("EXT_color_buffer_float") !== null;
    gl.getExtension("WEBGL_lose_context")?.loseContext();
    return { name: isUsable ? name : `${name}, without f32 render targets`, isUsable };
}
