/**
 * Deflections |A U q| of the domains of a scene in meters, with the linear part A of T. They are computed on the CPU
 * from the loaded U in f32.
 */

import { TRANSFORM_SIZE } from "./affine";
import type { SceneArrays, ShapeArrays } from "./arrays";
import { linearNorm, restSphere } from "./bounds";
import { at } from "./numbers";
import type { SceneModel } from "./scene_model";

/**
 * Largest number of entries of U that are read for the largest deflection of a scene. Reading them takes about 5 ms.
 */
const MAX_ENTRIES = 3e6;

/** Limit of sliders and pulls: deflection as a fraction of the body's size. Linear modes are wrong for larger ones. */
export const LARGEST_DEFLECTION = 0.1;
/** As `LARGEST_DEFLECTION`, for pulls on a model of large motion (`modalcast model --large`). */
export const LARGEST_LARGE_MOTION = 0.5;

/** The vertices of a shape that are evaluated. */
interface EvaluatedVertices {
    vertices: Uint32Array;
    /** Whether these are all vertices that triangles use. */
    isComplete: boolean;
    /** Largest norm of a vertex's row of U for each mode, over all vertices that triangles use. */
    norms: Float64Array;
    /** Diameter of the sphere around the vertices at rest. */
    diameter: number;
}

export class Deflections {
    /** One in this many vertices is evaluated. 1 unless the scene is large. */
    private readonly stride: number;
    private readonly evaluated: (EvaluatedVertices | undefined)[] = [];

    constructor(
        private readonly model: SceneModel,
        private readonly arrays: SceneArrays,
        maxEntries = MAX_ENTRIES,
    ) {
        const { scene } = model;
        const entries = scene.domains.reduce((sum, { shape }) => {
            const { vertices = 0, rank = 0 } = scene.shapes[shape] ?? {};
            return sum + 3 * vertices * rank;
        }, 0);
        this.stride = Math.max(1, Math.ceil(entries / maxEntries));
    }

    /**
     * Whether `largest` reads all vertices of a domain. Otherwise, it reads one in `stride` vertices and, for each
     * mode, the vertex that moves most. The result is then too small by about the difference between neighboring
     * vertices.
     */
    isExact(domain: number): boolean {
        return this.evaluatedOf(domain)?.isComplete ?? true;
    }

    /** Number of evaluated vertices. */
    count(domain: number): number {
        return this.evaluatedOf(domain)?.vertices.length ?? 0;
    }

    /**
     * Largest deflection of a domain at coordinates q in meters: |A U q| with the linear part A of T, if A scales all
     * axes equally, else an upper bound.
     */
    largest(domain: number, q: ArrayLike<number> = this.model.state.qOf(domain)): number {
        const modes = this.shapeOf(domain)?.modes;
        const evaluated = this.evaluatedOf(domain);
        if (!modes || !evaluated) return 0;
        return largestNorm(modes, evaluated.vertices, q) * this.metersPerUnit(domain);
    }

    /** Largest deflection of all domains. */
    largestOfScene(): number {
        return this.model.scene.domains.reduce((largest, { domain }) => Math.max(largest, this.largest(domain)), 0);
    }

    /** Largest deflection of a domain by one mode, in meters per unit of q. */
    ofMode(domain: number, mode: number): number {
        return (this.evaluatedOf(domain)?.norms[mode] ?? 0) * this.metersPerUnit(domain);
    }

    /** Largest |U_k| of a vertex for a mode k in all domains, in meters per unit of q and without the scale of T. */
    largestOfMode(mode: number): number {
        const { domains, info } = this.model.scene;
        const norms = domains.map(({ domain }) => this.evaluatedOf(domain)?.norms[mode] ?? 0);
        return norms.reduce((largest, norm) => Math.max(largest, norm), 0) * info.unit;
    }

    /** Size of a domain at rest in meters: the diameter of a sphere around it. */
    size(domain: number): number {
        return (this.evaluatedOf(domain)?.diameter ?? 0) * this.metersPerUnit(domain);
    }

    private shapeOf(domain: number): ShapeArrays | undefined {
        return this.arrays.shapes[this.model.scene.domains[domain]?.shape ?? -1];
    }

    private metersPerUnit(domain: number): number {
        const { state, scene } = this.model;
        return linearNorm(state.transforms, TRANSFORM_SIZE * domain) * scene.info.unit;
    }

    private evaluatedOf(domain: number): EvaluatedVertices | undefined {
        const { shape = -1 } = this.model.scene.domains[domain] ?? {};
        const arrays = this.arrays.shapes[shape];
        if (!arrays) return undefined;
        this.evaluated[shape] ??= selectVertices(arrays, this.model.scene.shapes[shape]?.rank ?? 0, this.stride);
        return this.evaluated[shape];
    }
}

function selectVertices(shape: ShapeArrays, rank: number, stride: number): EvaluatedVertices {
    const drawn = new Uint8Array(shape.restPositions.length / 3);
    for (const corner of shape.indices) drawn[at(shape.cornerVertices, corner)] = 1;
    const norms = new Float64Array(rank);
    const farthest = new Set<number>();
    const vertices: number[] = [];
    let count = 0;
    if (shape.modes) {
        for (let mode = 0; mode < rank; mode++) {
            const { vertex, norm } = farthestVertex(shape.modes, rank, mode, drawn);
            norms[mode] = norm;
            if (norm > 0) farthest.add(vertex);
        }
    }
    drawn.forEach((isDrawn, vertex) => {
        if (isDrawn && (count++ % stride === 0 || farthest.has(vertex))) vertices.push(vertex);
    });
    return {
        vertices: Uint32Array.from(vertices),
        isComplete: vertices.length === count,
        norms,
        diameter: 2 * restSphere(shape).radius,
    };
}

/** The vertex that a mode moves most, and the norm of its row of U. */
function farthestVertex(
    modes: Float32Array,
    rank: number,
    mode: number,
    drawn: Uint8Array,
): { vertex: number; norm: number } {
    let [vertex, largest] = [0, 0];
    for (let candidate = 0; candidate < drawn.length; candidate++) {
        if (!drawn[candidate]) continue;
        let squared = 0;
        for (let axis = 0; axis < 3; axis++) squared += at(modes, (3 * candidate + axis) * rank + mode) ** 2;
        if (squared > largest) [vertex, largest] = [candidate, squared];
    }
    return { vertex, norm: Math.sqrt(largest) };
}

/** The largest |U q| of some vertices, in scene units. */
function largestNorm(modes: Float32Array, vertices: Uint32Array, q: ArrayLike<number>): number {
    const rank = q.length;
    const values = Float64Array.from(q);
    if (values.every((value) => value === 0)) return 0;
    let largest = 0;
    for (const vertex of vertices) {
        let entry = 3 * vertex * rank;
        let squared = 0;
        for (let axis = 0; axis < 3; axis++) {
            let sum = 0;
            for (let mode = 0; mode < rank; mode++, entry++) sum += (modes[entry] as number) * (values[mode] as number);
            squared += sum * sum;
        }
        if (squared > largest) largest = squared;
    }
    return Math.sqrt(largest);
}
