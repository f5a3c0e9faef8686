/** The surfaces of a scene: one mesh with the corners of all domains, and one draw per material. */

import * as THREE from "three";
import { AlphaMode, type MaterialDescription } from "../proto/modalcast/v1/scenes_pb";
import type { SceneArrays } from "../scene/arrays";
import type { SceneDescription } from "../scene/description";
import { at } from "../scene/numbers";
import { AMBIENT_SURFACE_FRAGMENT, AMBIENT_SURFACE_VERTEX } from "./ambient_shaders";
import type { Deformer } from "./deformer";
import { setDefine } from "./fullscreen_pass";
import { mipChain } from "./mip_chain";
import {
    DOMAIN_FRAGMENT,
    DOMAIN_VERTEX,
    EDGE_FRAGMENT,
    EDGE_VERTEX,
    SHADOW_FRAGMENT,
    SHADOW_VERTEX,
    SURFACE_FRAGMENT,
    SURFACE_VERTEX,
} from "./shaders";

export type Uniforms = Record<string, THREE.IUniform>;

/** What the color of surfaces shows. */
export type ColorMode = { kind: "shaded" } | { kind: "map"; largest: number };

/** How textures are filtered. */
export interface TextureQuality {
    anisotropy: number;
    /** Whether two mipmap levels are blended, and shadows are smoothed by several lookups. */
    blendsLevels: boolean;
}

/** Bytes of the merged mesh. */
export function meshBytes(scene: SceneDescription): number {
    return scene.domains.reduce((sum, domain) => {
        const shape = scene.shapes[domain.shape];
        return shape ? sum + CORNER_BYTES * shape.corners + 12 * shape.triangles + 20 * shape.vertices : sum;
    }, 0);
}

/** Vertex and domain in two u32, an octahedral normal in two i16, and texture coordinates in two f32. */
const CORNER_BYTES = 20;

export class Surfaces {
    /** Opaque surfaces, and lines along their edges. */
    readonly colorScene = new THREE.Scene();
    /** Blended surfaces, as `Transparency` draws them. */
    readonly blendScene = new THREE.Scene();
    readonly blendMaterials: THREE.RawShaderMaterial[] = [];
    readonly shadowScene = new THREE.Scene();
    readonly domainScene = new THREE.Scene();
    /** Surfaces that occlude ambient light: those that are not blended. */
    readonly ambientScene = new THREE.Scene();
    private readonly geometry: THREE.BufferGeometry;
    private readonly colorMaterials: THREE.RawShaderMaterial[] = [];
    private readonly shadowMaterials: THREE.RawShaderMaterial[] = [];
    private readonly domainMaterials: THREE.RawShaderMaterial[] = [];
    private readonly ambientMaterials: THREE.RawShaderMaterial[] = [];
    private readonly textures = new Map<string, THREE.DataTexture>();
    private readonly blank: THREE.DataTexture;
    private readonly meshes: THREE.Mesh[];
    private edges: THREE.LineSegments | null = null;
    /** Indices of the triangles of opaque surfaces, which come first. */
    private opaqueIndices = 0;

    /**
     * @param light Uniforms that all surfaces share: light, eye, shadow map, color map.
     * @param layer Uniforms that all blended surfaces share: see `Transparency`.
     */
    constructor(
        private readonly scene: SceneDescription,
        private readonly arrays: SceneArrays,
        private readonly deformer: Deformer,
        private readonly light: Uniforms,
        private readonly layer: Uniforms,
        private readonly shadow: Uniforms,
        private readonly quality: TextureQuality,
    ) {
        this.blank = new THREE.DataTexture(new Uint8Array([255, 255, 255, 255]), 1, 1);
        this.blank.needsUpdate = true;
        this.geometry = this.mergeDomains();
        for (const material of scene.materials) this.addMaterial(material);
        const mesh = (materials: THREE.Material[], parent: THREE.Scene) => {
            const result = new THREE.Mesh(this.geometry, materials);
            result.frustumCulled = false;
            parent.add(result);
            return result;
        };
        const hidden = new THREE.MeshBasicMaterial({ visible: false });
        const select = (isBlended: boolean) =>
            this.colorMaterials.map((material) =>
                this.blendMaterials.includes(material) === isBlended ? material : hidden,
            );
        this.meshes = [
            mesh(select(false), this.colorScene),
            mesh(select(true), this.blendScene),
            mesh(this.shadowMaterials, this.shadowScene),
            mesh(this.domainMaterials, this.domainScene),
            mesh(this.ambientMaterials, this.ambientScene),
        ];
    }

    /** Places the meshes, whose positions are relative to the render origin. three.js multiplies matrices in f64. */
    moveTo(origin: readonly number[]): void {
        for (const object of this.edges ? [...this.meshes, this.edges] : this.meshes) {
            object.position.set(at(origin, 0), at(origin, 1), at(origin, 2));
        }
    }

    setColorMode(mode: ColorMode): void {
        this.define("COLOR_MAP", mode.kind === "map");
        if (mode.kind === "map") this.setLight("map_scale", mode.largest > 0 ? 1 / mode.largest : 0);
    }

    /** Defines or undefines a macro of SURFACE_FRAGMENT. */
    define(name: string, isDefined: boolean): void {
        for (const material of this.colorMaterials) setDefine(material, name, isDefined);
    }

    setEdges(isOn: boolean): void {
        if (isOn && !this.edges) {
            this.edges = this.createEdges();
            this.colorScene.add(this.edges);
            this.edges.position.copy(this.meshes[0]?.position ?? new THREE.Vector3());
        }
        if (this.edges) this.edges.visible = isOn;
        // Only with lines, because the offset shows back faces along outlines. Blended surfaces have no lines, and
        // their depths are compared with gl_FragCoord.z, which has no offset.
        for (const material of this.colorMaterials) {
            material.polygonOffset = isOn && !this.blendMaterials.includes(material);
        }
    }

    dispose(): void {
        this.geometry.dispose();
        const { colorMaterials, shadowMaterials, domainMaterials, ambientMaterials } = this;
        for (const material of [...colorMaterials, ...shadowMaterials, ...domainMaterials, ...ambientMaterials])
            material.dispose();
        for (const texture of this.textures.values()) texture.dispose();
        this.blank.dispose();
        if (this.edges) {
            this.edges.geometry.dispose();
            (this.edges.material as THREE.Material).dispose();
        }
    }

    private setLight(name: string, value: unknown): void {
        const uniform = this.light[name];
        if (uniform) uniform.value = value;
    }

    private addMaterial(material: MaterialDescription): void {
        const blends = material.alphaMode === AlphaMode.BLEND;
        const isMask = material.alphaMode === AlphaMode.MASK;
        const side = material.doubleSided ? THREE.DoubleSide : THREE.FrontSide;
        const table = {
            positions: { value: this.deformer.positions },
            transforms: { value: this.deformer.transforms },
        };
        const image = {
            color_texture: {
                value: this.texture(material.colorTexture, THREE.SRGBColorSpace, isMask ? material.alphaCutoff : 0),
            },
            alpha: { value: material.alpha },
            cutoff: { value: isMask ? material.alphaCutoff : 0 },
        };
        const create = (
            vertexShader: string,
            fragmentShader: string,
            uniforms: Uniforms,
            options: THREE.ShaderMaterialParameters,
        ) =>
            new THREE.RawShaderMaterial({
                glslVersion: THREE.GLSL3,
                vertexShader,
                fragmentShader,
                uniforms: { ...table, ...image, ...uniforms },
                ...options,
            });
        const defines: Record<string, string> = {};
        if (material.colorTexture !== undefined) defines["COLOR_TEXTURE"] = "";
        if (material.normalTexture !== undefined) defines["NORMAL_TEXTURE"] = "";
        if (isMask) defines["MASK"] = "";
        if (blends) defines["BLEND"] = "";
        if (!this.quality.blendsLevels) defines["SINGLE_LOOKUP"] = "";
        const phong = {
            ambient: { value: new THREE.Vector3(...material.ambient) },
            diffuse: { value: new THREE.Vector3(...material.diffuse) },
            specular: { value: new THREE.Vector3(...material.specular) },
            shininess: { value: material.shininess },
            normal_texture: { value: this.texture(material.normalTexture, THREE.NoColorSpace) },
        };
        const color = create(
            SURFACE_VERTEX,
            SURFACE_FRAGMENT,
            { ...this.light, ...phong, ...(blends ? this.layer : {}) },
            {
                side,
                defines,
                polygonOffsetFactor: 0.5,
                polygonOffsetUnits: 1,
            },
        );
        const cutsOut = isMask || blends;
        const shadow = create(SHADOW_VERTEX, SHADOW_FRAGMENT, this.shadow, {
            side: THREE.DoubleSide,
            defines: cutsOut ? { CUT_OUT: "" } : {},
            polygonOffset: true,
            polygonOffsetFactor: 1,
            polygonOffsetUnits: 2,
        });
        // As on the server, blended surfaces cast a shadow where alpha is at least 0.5.
        if (blends) shadow.uniforms["cutoff"] = { value: 0.5 };
        const opaqueOnly = { side, defines: isMask ? { MASK: "" } : {}, visible: !blends };
        const domain = create(DOMAIN_VERTEX, DOMAIN_FRAGMENT, {}, opaqueOnly);
        const ambient = create(AMBIENT_SURFACE_VERTEX, AMBIENT_SURFACE_FRAGMENT, this.light, opaqueOnly);
        this.colorMaterials.push(color);
        if (blends) this.blendMaterials.push(color);
        this.shadowMaterials.push(shadow);
        this.domainMaterials.push(domain);
        this.ambientMaterials.push(ambient);
    }

    /** @param cutoff Alpha from which the image is visible; 0 if the image cuts nothing out. */
    private texture(index: number | undefined, colorSpace: THREE.ColorSpace, cutoff = 0): THREE.Texture {
        const description = index === undefined ? undefined : this.scene.textures[index];
        const pixels = index === undefined ? undefined : this.arrays.textures[index];
        if (!description || !pixels) return this.blank;
        const { width, height } = description;
        const key = `${index} ${colorSpace} ${cutoff}`;
        const known = this.textures.get(key);
        if (known) return known;
        const texture = new THREE.DataTexture(pixels, width, height);
        texture.colorSpace = colorSpace;
        texture.wrapS = THREE.RepeatWrapping;
        texture.wrapT = THREE.RepeatWrapping;
        // As on the server, two levels are blended on a GPU only.
        texture.minFilter = this.quality.blendsLevels
            ? THREE.LinearMipmapLinearFilter
            : THREE.LinearMipmapNearestFilter;
        texture.magFilter = THREE.LinearFilter;
        if (cutoff > 0) texture.mipmaps = mipChain(pixels, width, height, cutoff);
        texture.generateMipmaps = cutoff <= 0;
        texture.anisotropy = this.quality.anisotropy;
        texture.needsUpdate = true;
        this.textures.set(key, texture);
        return texture;
    }

    /** Triangles of all domains, ordered by material: opaque ones first, blended ones last. */
    private mergeDomains(): THREE.BufferGeometry {
        const { scene } = this;
        const total = { corners: 0, triangles: 0 };
        for (const domain of scene.domains) {
            total.corners += scene.shapes[domain.shape]?.corners ?? 0;
            total.triangles += scene.shapes[domain.shape]?.triangles ?? 0;
        }
        const hasUvs = this.arrays.shapes.some((shape) => shape.uvs);
        const vertex = new Uint32Array(2 * total.corners);
        const normal = new Int16Array(2 * total.corners);
        const uv = new Float32Array(hasUvs ? 2 * total.corners : 0);
        const firstCorner: number[] = [];
        let corner = 0;
        for (const domain of scene.domains) {
            const shape = this.arrays.shapes[domain.shape];
            firstCorner.push(corner);
            if (!shape) continue;
            const firstVertex = at(this.deformer.firstVertex, domain.domain);
            if (shape.uvs) uv.set(shape.uvs, 2 * corner);
            normal.set(octahedralNormals(shape.normals), 2 * corner);
            for (const shapeVertex of shape.cornerVertices) {
                vertex[2 * corner] = firstVertex + shapeVertex;
                vertex[2 * corner + 1] = domain.domain;
                corner++;
            }
        }
        const geometry = new THREE.BufferGeometry();
        const vertices = new THREE.BufferAttribute(vertex, 2);
        vertices.gpuType = THREE.IntType;
        geometry.setAttribute("vertex", vertices);
        geometry.setAttribute("normal", new THREE.BufferAttribute(normal, 2, true));
        if (hasUvs) geometry.setAttribute("uv", new THREE.BufferAttribute(uv, 2));
        this.setIndex(geometry, firstCorner, total.triangles);
        return geometry;
    }

    private setIndex(geometry: THREE.BufferGeometry, firstCorner: readonly number[], triangles: number): void {
        const { scene } = this;
        const index = new Uint32Array(3 * triangles);
        let place = 0;
        const order = scene.materials.map((material) => material.material);
        const rank = (material: number) => (scene.materials[material]?.alphaMode === AlphaMode.BLEND ? 1 : 0);
        order.sort((a, b) => rank(a) - rank(b) || a - b);
        const ranges = this.rangesByMaterial();
        for (const material of order) {
            const first = place;
            for (const { domain, begin, end } of ranges.get(material) ?? []) {
                const indices = this.arrays.shapes[scene.domains[domain]?.shape ?? 0]?.indices ?? new Uint32Array();
                const offset = at(firstCorner, domain);
                for (let i = 3 * begin; i < 3 * end; i++) index[place++] = at(indices, i) + offset;
            }
            if (place > first) geometry.addGroup(first, place - first, material);
            if (rank(material) === 0) this.opaqueIndices = place;
        }
        geometry.setIndex(new THREE.BufferAttribute(index, 1));
    }

    private rangesByMaterial(): Map<number, { domain: number; begin: number; end: number }[]> {
        const result = new Map<number, { domain: number; begin: number; end: number }[]>();
        for (const domain of this.scene.domains) {
            const triangles = this.scene.shapes[domain.shape]?.triangles ?? 0;
            const ranges =
                domain.materialRanges.length > 0
                    ? domain.materialRanges
                    : [{ firstTriangle: 0, material: domain.material }];
            ranges.forEach((range, i) => {
                const list = result.get(range.material) ?? [];
                const end = Math.min(ranges[i + 1]?.firstTriangle ?? triangles, triangles);
                list.push({ domain: domain.domain, begin: range.firstTriangle, end });
                result.set(range.material, list);
            });
        }
        return result;
    }

    /**
     * Lines along the triangle edges of opaque surfaces, each once. The description does not mark the diagonals of
     * polygons.
     */
    private createEdges(): THREE.LineSegments {
        const index = this.geometry.getIndex()?.array ?? new Uint32Array();
        const vertices = this.geometry.getAttribute("vertex").array;
        const lines: number[] = [];
        const seen = new Set<number>();
        for (let corner = 0; corner < this.opaqueIndices; corner++) {
            const a = at(index, corner);
            const b = at(index, corner % 3 === 2 ? corner - 2 : corner + 1);
            const [u, v] = [at(vertices, 2 * a), at(vertices, 2 * b)];
            // Numbers up to 2^53 are exact, so the key is unique below 2^26 vertices.
            const key = Math.min(u, v) * 2 ** 26 + Math.max(u, v);
            if (seen.has(key)) continue;
            seen.add(key);
            lines.push(a, b);
        }
        const geometry = new THREE.BufferGeometry();
        geometry.setAttribute("vertex", this.geometry.getAttribute("vertex"));
        geometry.setIndex(new THREE.BufferAttribute(new Uint32Array(lines), 1));
        const material = new THREE.RawShaderMaterial({
            glslVersion: THREE.GLSL3,
            vertexShader: EDGE_VERTEX,
            fragmentShader: EDGE_FRAGMENT,
            uniforms: {
                positions: { value: this.deformer.positions },
                transforms: { value: this.deformer.transforms },
            },
            transparent: true,
            depthWrite: false,
        });
        const edges = new THREE.LineSegments(geometry, material);
        edges.frustumCulled = false;
        return edges;
    }
}

/** Unit vectors as two i16: see ENCODING_OCTAHEDRAL_I16 in vertices.proto. */
export function octahedralNormals(normals: Float32Array): Int16Array {
    const result = new Int16Array((2 * normals.length) / 3);
    for (let corner = 0; corner < normals.length / 3; corner++) {
        const [x, y, z] = [at(normals, 3 * corner), at(normals, 3 * corner + 1), at(normals, 3 * corner + 2)];
        const sum = Math.abs(x) + Math.abs(y) + Math.abs(z);
        let [u, v] = sum > 0 ? [x / sum, y / sum] : [0, 0];
        if (z < 0) [u, v] = [(1 - Math.abs(v)) * (u < 0 ? -1 : 1), (1 - Math.abs(u)) * (v < 0 ? -1 : 1)];
        result[2 * corner] = Math.round(32767 * u);
        result[2 * corner + 1] = Math.round(32767 * v);
    }
    return result;
}
