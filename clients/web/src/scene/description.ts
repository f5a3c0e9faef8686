/** The description of a scene: meshes, modes, materials and domains, without the arrays. */

import type {
    DescribeSceneResponse,
    DomainDescription,
    MaterialDescription,
    SceneInfo,
    ShapeDescription,
    TextureDescription,
} from "../proto/modalcast/v1/scenes_pb";
import { Array as ArrayKind } from "../proto/modalcast/v1/scenes_pb";

export { ArrayKind };

/** Largest eigenvalue of a rigid motion as a fraction of the largest of its domain. */
const RIGID_TOLERANCE = 1e-9;

export interface SceneDescription {
    info: SceneInfo;
    shapes: ShapeDescription[];
    materials: MaterialDescription[];
    textures: TextureDescription[];
    domains: DomainDescription[];
}

/** Collects the parts of a reply to DescribeScene. */
export class DescriptionCollector {
    private info: SceneInfo | null = null;
    private readonly shapes: ShapeDescription[] = [];
    private readonly materials: MaterialDescription[] = [];
    private readonly textures: TextureDescription[] = [];
    private readonly domains: DomainDescription[] = [];

    add({ part }: DescribeSceneResponse): void {
        if (part.case === "scene") this.info = part.value;
        else if (part.case === "shapes") this.shapes.push(...part.value.shapes);
        else if (part.case === "materials") this.materials.push(...part.value.materials);
        else if (part.case === "textures") this.textures.push(...part.value.textures);
        else if (part.case === "domains") this.domains.push(...part.value.domains);
    }

    /** Throws if the description is incomplete, or if an index refers to nothing. */
    finish(): SceneDescription {
        const { info, shapes, materials, textures, domains } = this;
        if (!info) throw new Error("scene description: expected a part `scene`, got none");
        checkIndices(
            "shapes",
            shapes.map((shape) => shape.shape),
        );
        checkIndices(
            "materials",
            materials.map((material) => material.material),
        );
        checkIndices(
            "textures",
            textures.map((texture) => texture.texture),
        );
        checkIndices(
            "domains",
            domains.map((domain) => domain.domain),
        );
        for (const domain of domains) {
            const name = `domains[${domain.domain}]`;
            checkBelow(`${name}.shape`, domain.shape, shapes.length);
            checkBelow(`${name}.material`, domain.material, materials.length);
            for (const range of domain.materialRanges) checkBelow(`${name}.material`, range.material, materials.length);
            for (const other of [domain.parent, domain.follows, domain.sharesQWith]) {
                if (other !== undefined) checkBelow(`${name}: index of another domain`, other, domain.domain);
            }
        }
        return { info, shapes, materials, textures, domains };
    }
}

function checkIndices(name: string, indices: number[]): void {
    const wrong = indices.findIndex((value, index) => value !== index);
    if (wrong >= 0)
        throw new Error(`scene description: expected ${name}[${wrong}] to have this index, got ${indices[wrong]}`);
}

function checkBelow(name: string, value: number, limit: number): void {
    if (value >= limit) throw new Error(`scene description: ${name}: expected below ${limit}, got ${value}`);
}

/** The hash of an array of a shape; null if the array is empty. */
export function arrayHash(shape: ShapeDescription, kind: ArrayKind): Uint8Array | null {
    const array = shape.arrays.find((description) => description.array === kind);
    return array && array.bytes > 0n ? array.sha256 : null;
}

/** Number of modes of a domain. */
export function rankOf(scene: SceneDescription, domain: DomainDescription): number {
    return scene.shapes[domain.shape]?.rank ?? 0;
}

/** Squared angular frequencies of a domain's modes in (rad/s)^2; empty if they are unknown. */
export function eigenvaluesOf(scene: SceneDescription, domain: number): readonly number[] {
    const description = scene.domains[domain];
    return description?.eigenvalues?.values ?? scene.shapes[description?.shape ?? -1]?.eigenvalues ?? [];
}

/**
 * Largest eigenvalue of a mode that may be a rigid motion, for which solvers return rounding errors. The physics
 * process does not move such modes.
 */
export function largestRigidEigenvalue(eigenvalues: readonly number[]): number {
    return RIGID_TOLERANCE * eigenvalues.reduce((largest, value) => Math.max(largest, value), 0);
}

/** The lowest frequency of all vibrations in hertz; 0 if it is unknown. */
export function lowestHertz(scene: SceneDescription): number {
    const lowest = scene.domains.map(({ domain }) => {
        const eigenvalues = eigenvaluesOf(scene, domain);
        const smallest = largestRigidEigenvalue(eigenvalues);
        return Math.min(...eigenvalues.filter((value) => value > smallest));
    });
    const smallest = lowest.reduce((least, value) => Math.min(least, value), Infinity);
    return Number.isFinite(smallest) ? Math.sqrt(smallest) / (2 * Math.PI) : 0;
}

/** Frequency of a mode in hertz; 0 if it is unknown, or if the mode has no stiffness. */
export function hertzOf(scene: SceneDescription, domain: number, mode: number): number {
    return Math.sqrt(Math.max(0, eigenvaluesOf(scene, domain)[mode] ?? 0)) / (2 * Math.PI);
}

/** Frequency of a mode in hertz if it is the same in all domains that have the mode; otherwise 0. */
export function commonHertz(scene: SceneDescription, mode: number): number {
    const domains = scene.domains.filter((domain) => mode < rankOf(scene, domain));
    const frequencies = new Set(domains.map(({ domain }) => hertzOf(scene, domain, mode)));
    return frequencies.size === 1 ? ([...frequencies][0] ?? 0) : 0;
}

/** Bytes of U of all shapes in f32. */
export function modeBytes(scene: SceneDescription): number {
    return scene.shapes.reduce((sum, shape) => sum + 12 * shape.vertices * shape.rank, 0);
}
