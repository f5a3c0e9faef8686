/** A fragment shader that runs once for each pixel of a target. */

import * as THREE from "three";
import { FULLSCREEN_VERTEX } from "./shaders";

export class FullscreenPass {
    readonly mesh: THREE.Mesh<THREE.BufferGeometry, THREE.RawShaderMaterial>;
    private readonly scene = new THREE.Scene();
    private readonly camera = new THREE.Camera();

    /** @param options Of the material, for example how it blends with the target. */
    constructor(
        fragmentShader: string,
        uniforms: Record<string, unknown>,
        options: THREE.ShaderMaterialParameters = {},
    ) {
        const geometry = new THREE.BufferGeometry();
        geometry.setDrawRange(0, 3);
        const material = new THREE.RawShaderMaterial({
            glslVersion: THREE.GLSL3,
            vertexShader: FULLSCREEN_VERTEX,
            fragmentShader,
            uniforms: Object.fromEntries(Object.entries(uniforms).map(([name, value]) => [name, { value }])),
            depthTest: false,
            depthWrite: false,
            ...options,
        });
        this.mesh = new THREE.Mesh(geometry, material);
        this.mesh.frustumCulled = false;
        this.scene.add(this.mesh);
    }

    setUniform(name: string, value: unknown): void {
        const uniform = this.mesh.material.uniforms[name];
        if (uniform) uniform.value = value;
        else this.mesh.material.uniforms[name] = { value };
    }

    /** Defines or undefines a macro of the shader. */
    define(name: string, isDefined: boolean): void {
        setDefine(this.mesh.material, name, isDefined);
    }

    render(renderer: THREE.WebGLRenderer, target: THREE.WebGLRenderTarget | null): void {
        renderer.setRenderTarget(target);
        renderer.render(this.scene, this.camera);
        renderer.setRenderTarget(null);
    }

    dispose(): void {
        this.mesh.geometry.dispose();
        this.mesh.material.dispose();
    }
}

/** Defines or undefines a macro; the shader is compiled again only if that changes it. */
export function setDefine(material: THREE.RawShaderMaterial, name: string, isDefined: boolean): void {
    if (name in material.defines === isDefined) return;
    if (isDefined) material.defines[name] = "";
    else delete material.defines[name];
    material.needsUpdate = true;
}
