/** Deforms all vertices of a scene on the GPU, once per state: a fragment per vertex writes a texture of positions. */

import * as THREE from "three";
import { applyToPoint, TRANSFORM_SIZE, type Vec3 } from "../scene/affine";
import type { SceneArrays } from "../scene/arrays";
import type { SceneDescription } from "../scene/description";
import { at } from "../scene/numbers";
import { modeGroups, type PackedFormat, type PackedModes, packModes, relativeError } from "../scene/packed_modes";
import type { SceneState } from "../scene/state";
import { FullscreenPass } from "./fullscreen_pass";
import { DEFORM_FRAGMENT } from "./shaders";
import { FORMATS, paddedEntries, TABLE_WIDTH, tableTexture, WIDTH } from "./texture_tables";

/** Texels per domain in the table of transforms: three rows of T, then visibility, highlight and two unused values. */
const TRANSFORM_TEXELS = 4;
const NO_DOMAIN = 0xffffffff;

/** How domains are shown. */
export interface DomainDisplay {
    hidden: ReadonlySet<number>;
    highlighted: number | null;
}

export class Deformer {
    readonly format: PackedFormat;
    /** Packed U of each shape, without the texels; null for rigid shapes. */
    readonly packed: (Omit<PackedModes, "texels"> | null)[];
    /** First vertex of each domain in the texture of positions. */
    readonly firstVertex: number[] = [];
    readonly transforms: THREE.DataTexture;
    private readonly transformValues: Float32Array<ArrayBuffer>;
    private readonly coordinates: THREE.DataTexture;
    private readonly coordinateValues: Float32Array<ArrayBuffer>;
    private shownCoordinates: THREE.DataTexture | null = null;
    private readonly firstGroup: number[] = [];
    private readonly target: THREE.WebGLRenderTarget;
    private readonly pass: FullscreenPass;
    private readonly textures: THREE.Texture[];
    /** The point that the rest positions of each shape are relative to. */
    private readonly shapeOrigins: Vec3[];

    constructor(
        private readonly renderer: THREE.WebGLRenderer,
        private readonly scene: SceneDescription,
        arrays: SceneArrays,
    ) {
        this.shapeOrigins = arrays.shapes.map((shape) => shape.origin);
        const modes = packScene(scene, arrays);
        this.format = modes.format;
        this.packed = modes.shapes;
        const table = this.layOut(modes.firstTexel);
        const transformEntries = paddedEntries(TRANSFORM_TEXELS * scene.domains.length, TABLE_WIDTH);
        this.transformValues = new Float32Array(4 * transformEntries);
        this.transforms = tableTexture(this.transformValues, 4, TABLE_WIDTH, FORMATS.f32);
        this.coordinateValues = new Float32Array(4 * paddedEntries(this.groupCount(), TABLE_WIDTH));
        this.coordinates = tableTexture(this.coordinateValues, 4, TABLE_WIDTH, FORMATS.f32);
        const vertexDomains = this.vertexDomains();
        const height = vertexDomains.length / WIDTH;
        this.target = new THREE.WebGLRenderTarget(WIDTH, height, {
            type: THREE.FloatType,
            format: THREE.RGBAFormat,
            minFilter: THREE.NearestFilter,
            magFilter: THREE.NearestFilter,
            depthBuffer: false,
            generateMipmaps: false,
        });
        const packedFormat = modes.format === "f16" ? FORMATS.f16 : FORMATS.i16;
        const inputs = {
            vertex_domains: tableTexture(vertexDomains, 1, WIDTH, FORMATS.u32),
            rest_positions: tableTexture(restPositions(arrays), 4, TABLE_WIDTH, FORMATS.f32),
            domain_table: tableTexture(table, 4, TABLE_WIDTH, FORMATS.i32),
            modes: tableTexture(modes.texels, 4, TABLE_WIDTH, packedFormat),
        };
        this.textures = Object.values(inputs);
        this.pass = new FullscreenPass(DEFORM_FRAGMENT, {
            ...inputs,
            transforms: this.transforms,
            coordinates: this.coordinates,
            shown_coordinates: null,
        });
        this.pass.define("I16", modes.format === "i16");
    }

    /** xyz: deformed positions in scene units relative to the origin of `deform`; w: the value of the color map. */
    get positions(): THREE.Texture {
        return this.target.texture;
    }

    /** Bytes of textures, for the panel. */
    get bytes(): number {
        const size = (texture: THREE.Texture) =>
            (texture.image as { data: ArrayBufferView | null }).data?.byteLength ?? 0;
        return this.textures.reduce((sum, texture) => sum + size(texture), 16 * this.target.width * this.target.height);
    }

    /** Selects the value of color maps: one mode, or (null) the displacement. */
    showMode(mode: number | null): void {
        this.pass.define("MODE_SHAPE", mode !== null);
        if (mode === null) return;
        const values = new Float32Array(this.coordinateValues.length);
        for (const domain of this.scene.domains) {
            const packed = this.packed[domain.shape];
            if (!packed || mode >= packed.scales.length) continue;
            values[4 * at(this.firstGroup, domain.domain) + mode] = at(packed.scales, mode);
        }
        this.shownCoordinates?.dispose();
        this.shownCoordinates = tableTexture(values, 4, TABLE_WIDTH, FORMATS.f32);
        this.pass.setUniform("shown_coordinates", this.shownCoordinates);
    }

    /**
     * Deforms all vertices.
     *
     * @param origin The render origin in scene units: it is subtracted in f64 before the transforms are rounded to f32. The
     * translation A c + t belongs to rest positions relative to the origin c of their shape.
     */
    deform(state: SceneState, origin: readonly number[], display: DomainDisplay): void {
        for (let domain = 0; domain < this.scene.domains.length; domain++) {
            const place = 4 * TRANSFORM_TEXELS * domain;
            const translation = applyToPoint(
                state.transforms,
                TRANSFORM_SIZE * domain,
                this.shapeOrigins[at(this.shapeOf, domain)] ?? [0, 0, 0],
            );
            for (let entry = 0; entry < TRANSFORM_SIZE; entry++) {
                const axis = entry >> 2;
                this.transformValues[place + entry] =
                    entry % 4 === 3
                        ? at(translation, axis) - at(origin, axis)
                        : at(state.transforms, TRANSFORM_SIZE * domain + entry);
            }
            this.transformValues[place + TRANSFORM_SIZE] = display.hidden.has(domain) ? 0 : 1;
            this.transformValues[place + TRANSFORM_SIZE + 1] = display.highlighted === domain ? 1 : 0;
            const packed = this.packed[at(this.shapeOf, domain)];
            if (!packed) continue;
            const q = state.qOf(domain);
            const first = 4 * at(this.firstGroup, domain);
            for (let mode = 0; mode < q.length; mode++)
                this.coordinateValues[first + mode] = at(q, mode) * at(packed.scales, mode);
        }
        this.transforms.needsUpdate = true;
        this.coordinates.needsUpdate = true;
        this.pass.render(this.renderer, this.target);
    }

    /** Deformed positions of all vertices: 4 numbers each. For tests; it waits for the GPU. */
    readPositions(): Float32Array {
        const { width, height } = this.target;
        const positions = new Float32Array(4 * width * height);
        this.renderer.readRenderTargetPixels(this.target, 0, 0, width, height, positions);
        return positions;
    }

    dispose(): void {
        for (const texture of [...this.textures, this.transforms, this.coordinates]) texture.dispose();
        this.shownCoordinates?.dispose();
        this.target.dispose();
        this.pass.dispose();
    }

    private readonly shapeOf: number[] = [];

    private groupCount(): number {
        return this.scene.domains.reduce(
            (sum, domain) => sum + modeGroups(this.scene.shapes[domain.shape]?.rank ?? 0),
            0,
        );
    }

    /**
     * Four numbers for each domain: its first vertex minus the first vertex of its shape; a texel of U; the number of
     * groups of four modes; the first texel of its coordinates. For vertex v of the table of rest positions, the shader
     * adds 3 groups v to the texel of U.
     */
    private layOut(firstTexel: readonly number[]): Int32Array<ArrayBuffer> {
        const table = new Int32Array(4 * paddedEntries(this.scene.domains.length, TABLE_WIDTH));
        const firstShapeVertex = firstVertices(this.scene);
        let vertex = 0;
        let group = 0;
        for (const domain of this.scene.domains) {
            const shape = this.scene.shapes[domain.shape];
            if (!shape) continue;
            const groups = modeGroups(shape.rank);
            const first = at(firstShapeVertex, domain.shape);
            table.set(
                [vertex - first, at(firstTexel, domain.shape) - 3 * groups * first, groups, group],
                4 * domain.domain,
            );
            this.firstVertex.push(vertex);
            this.firstGroup.push(group);
            this.shapeOf.push(domain.shape);
            vertex += shape.vertices;
            group += groups;
        }
        return table;
    }

    private vertexDomains(): Uint32Array<ArrayBuffer> {
        const last = this.scene.domains.at(-1);
        const count = last ? at(this.firstVertex, last.domain) + (this.scene.shapes[last.shape]?.vertices ?? 0) : 0;
        const domains = new Uint32Array(paddedEntries(count, WIDTH)).fill(NO_DOMAIN);
        for (const domain of this.scene.domains) {
            const first = at(this.firstVertex, domain.domain);
            domains.fill(domain.domain, first, first + (this.scene.shapes[domain.shape]?.vertices ?? 0));
        }
        return domains;
    }
}

/** First vertex of each shape in the table of rest positions. */
function firstVertices(scene: SceneDescription): number[] {
    let vertex = 0;
    return scene.shapes.map((shape) => {
        const first = vertex;
        vertex += shape.vertices;
        return first;
    });
}

function restPositions(arrays: SceneArrays): Float32Array<ArrayBuffer> {
    const vertices = arrays.shapes.reduce((sum, shape) => sum + shape.restPositions.length / 3, 0);
    const values = new Float32Array(4 * paddedEntries(vertices, TABLE_WIDTH));
    let place = 0;
    for (const { restPositions: positions } of arrays.shapes) {
        for (let vertex = 0; vertex < positions.length / 3; vertex++, place += 4) {
            values.set(positions.subarray(3 * vertex, 3 * vertex + 3), place);
        }
    }
    return values;
}

interface PackedScene {
    format: PackedFormat;
    shapes: (Omit<PackedModes, "texels"> | null)[];
    firstTexel: number[];
    texels: Uint16Array<ArrayBuffer> | Int16Array<ArrayBuffer>;
}

/** Packs U of all shapes in the format with the smaller largest relative error. */
function packScene(scene: SceneDescription, arrays: SceneArrays): PackedScene {
    const packAll = (format: PackedFormat) =>
        scene.shapes.map((shape, index) => {
            const modes = arrays.shapes[index]?.modes;
            return modes ? packModes(modes, shape.vertices, shape.rank, format) : null;
        });
    const largestError = (shapes: (PackedModes | null)[]) =>
        shapes.reduce((largest, packed) => Math.max(largest, packed ? relativeError(packed) : 0), 0);
    const integers = packAll("i16");
    const halves = packAll("f16");
    const format: PackedFormat = largestError(halves) < largestError(integers) ? "f16" : "i16";
    const chosen = format === "f16" ? halves : integers;
    let texel = 0;
    const firstTexel = chosen.map((packed) => {
        const first = texel;
        texel += packed ? packed.texels.length / 4 : 0;
        return first;
    });
    const length = 4 * paddedEntries(texel, TABLE_WIDTH);
    const texels = format === "f16" ? new Uint16Array(length) : new Int16Array(length);
    chosen.forEach((packed, shape) => {
        if (packed) texels.set(packed.texels, 4 * at(firstTexel, shape));
    });
    const shapes = chosen.map(
        (packed) => packed && { format, scales: packed.scales, errors: packed.errors, norms: packed.norms },
    );
    return { format, shapes, firstTexel, texels };
}
