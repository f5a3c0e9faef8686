/** States of a scene: the coordinates q and the transforms T of all domains at a step. */

import type { StepId } from "../proto/modalcast/v1/common_pb";
import { type StateChunk, StateContent, type StateHead } from "../proto/modalcast/v1/states_pb";
import { IDENTITY, multiply, TRANSFORM_SIZE } from "./affine";
import { rankOf, type SceneDescription } from "./description";
import { at, toF32, toF64, toU32 } from "./numbers";

/** Where the values of each domain are in a state. */
export class StateLayout {
    /** Index of the first coordinate of each domain. Domains that share coordinates have the same. */
    readonly firstCoordinate: number[] = [];
    readonly ranks: number[] = [];
    /** Index of the domain whose coordinates each domain has. */
    readonly owner: number[] = [];
    /** Index of the root of each domain: the end of the chain of domains that it follows, or the domain itself. */
    readonly root: number[] = [];
    /** 12 numbers for each domain: the transform root_from_domain. */
    readonly rootFromDomain: Float64Array;
    readonly coordinates: number;
    readonly domains: number;
    /** The domains with coordinates of their own. */
    readonly owners: Uint32Array;
    /** The domains with transforms of their own. */
    readonly roots: Uint32Array;

    constructor(readonly scene: SceneDescription) {
        this.domains = scene.domains.length;
        this.rootFromDomain = new Float64Array(TRANSFORM_SIZE * this.domains);
        let coordinates = 0;
        for (const domain of scene.domains) {
            const index = domain.domain;
            const rank = rankOf(scene, domain);
            this.ranks.push(rank);
            const shared = domain.sharesQWith;
            this.owner.push(shared === undefined ? index : at(this.owner, shared));
            this.firstCoordinate.push(shared === undefined ? coordinates : at(this.firstCoordinate, shared));
            if (shared === undefined) coordinates += rank;
            else if (at(this.ranks, shared) !== rank) {
                throw new Error(
                    `domains[${index}].shares_q_with: expected ${at(this.ranks, shared)} modes, got ${rank}`,
                );
            }
            if (domain.follows === undefined) {
                this.root.push(index);
                this.rootFromDomain.set(IDENTITY, TRANSFORM_SIZE * index);
            } else {
                this.root.push(at(this.root, domain.follows));
                const frame = domain.followFrame.length > 0 ? domain.followFrame : domain.attachmentFrame;
                const matrix = frame.length > 0 ? toF32(frame, `domains[${index}].follow_frame`) : IDENTITY;
                const followed = TRANSFORM_SIZE * domain.follows;
                multiply(this.rootFromDomain, TRANSFORM_SIZE * index, this.rootFromDomain, followed, matrix, 0);
            }
        }
        this.coordinates = coordinates;
        const indices = Uint32Array.from({ length: this.domains }, (_, index) => index);
        this.owners = indices.filter((domain) => this.owner[domain] === domain);
        this.roots = indices.filter((domain) => this.isRoot(domain));
    }

    isRoot(domain: number): boolean {
        return this.root[domain] === domain;
    }
}

/** The newest state. Changes are applied in place. */
export class SceneState {
    /** All coordinates, see `StateLayout.firstCoordinate`. */
    readonly q: Float32Array;
    /** 12 numbers for each root: world_from_domain, in scene units relative to its entry in `rootOrigins`. */
    readonly rootTransforms: Float32Array;
    /** 3 numbers for each root: the origin of its transform, in scene units relative to the scene's origin. */
    readonly rootOrigins: Float64Array;
    /** 12 numbers for each domain: world_from_domain, in scene units relative to the scene's origin. */
    readonly transforms: Float64Array;
    step: StepId | null = null;

    /** The rest state. */
    constructor(readonly layout: StateLayout) {
        const { scene } = layout;
        this.q = new Float32Array(layout.coordinates);
        this.rootTransforms = new Float32Array(TRANSFORM_SIZE * layout.domains);
        this.rootOrigins = new Float64Array(3 * layout.domains);
        this.transforms = new Float64Array(TRANSFORM_SIZE * layout.domains);
        for (const domain of scene.domains) {
            const placement = domain.placement.length > 0 ? toF32(domain.placement, "placement") : IDENTITY;
            this.rootTransforms.set(placement, TRANSFORM_SIZE * domain.domain);
            // A placement that is far from the scene's origin also has f64 numbers.
            if (domain.exactPlacement.length === TRANSFORM_SIZE) {
                for (let axis = 0; axis < 3; axis++) {
                    this.rootTransforms[TRANSFORM_SIZE * domain.domain + 4 * axis + 3] = 0;
                    this.rootOrigins[3 * domain.domain + axis] = at(domain.exactPlacement, 4 * axis + 3);
                }
            }
            if (domain.restQ.length > 0 && layout.owner[domain.domain] === domain.domain) {
                this.q.set(toF32(domain.restQ, "rest_q"), at(layout.firstCoordinate, domain.domain));
            }
        }
        this.updateTransforms();
    }

    qOf(domain: number): Float32Array {
        const first = at(this.layout.firstCoordinate, domain);
        return this.q.subarray(first, first + at(this.layout.ranks, domain));
    }

    /** Computes the transforms of all domains from those of the roots. */
    updateTransforms(): void {
        const { layout, transforms } = this;
        const world = new Float64Array(TRANSFORM_SIZE);
        for (let domain = 0; domain < layout.domains; domain++) {
            const root = at(layout.root, domain);
            for (let entry = 0; entry < TRANSFORM_SIZE; entry++) {
                world[entry] = at(this.rootTransforms, TRANSFORM_SIZE * root + entry);
            }
            for (let axis = 0; axis < 3; axis++)
                world[4 * axis + 3] = at(world, 4 * axis + 3) + at(this.rootOrigins, 3 * root + axis);
            if (root === domain) transforms.set(world, TRANSFORM_SIZE * domain);
            else {
                const place = TRANSFORM_SIZE * domain;
                multiply(transforms, place, world, 0, layout.rootFromDomain, place);
            }
        }
    }

    /** Applies the sections of a state. Throws if a section does not fit the scene. */
    apply(head: StateHead, data: Uint8Array): void {
        const section = (content: StateContent) => {
            const found = head.sections.find((candidate) => candidate.content === content);
            if (!found) return new Uint8Array();
            const end = Number(found.offset + found.bytes);
            if (end > data.length) throw new Error(`state: expected ${end} bytes, got ${data.length}`);
            return data.subarray(Number(found.offset), end);
        };
        // A list that is left out has all domains.
        const q = toF32(section(StateContent.Q));
        const listed = toU32(section(StateContent.Q_DOMAINS));
        this.applyCoordinates(listed.length > 0 || q.length === 0 ? listed : this.layout.owners, q);
        const transforms = toF32(section(StateContent.TRANSFORMS));
        const roots = toU32(section(StateContent.TRANSFORM_DOMAINS));
        const moved = roots.length > 0 || transforms.length === 0 ? roots : this.layout.roots;
        if (transforms.length !== TRANSFORM_SIZE * moved.length) {
            throw new Error(
                `state: expected ${TRANSFORM_SIZE * moved.length} numbers of transforms, got ${transforms.length}`,
            );
        }
        moved.forEach((domain, place) => {
            if (domain >= this.layout.domains)
                throw new Error(`state: expected a domain below ${this.layout.domains}, got ${domain}`);
            const first = TRANSFORM_SIZE * place;
            this.rootTransforms.set(transforms.subarray(first, first + TRANSFORM_SIZE), TRANSFORM_SIZE * domain);
        });
        this.applyOrigins(toF64(section(StateContent.ORIGINS)));
        this.step = head.step ?? null;
        this.updateTransforms();
    }

    private applyCoordinates(domains: Iterable<number>, q: Float32Array): void {
        let place = 0;
        for (const domain of domains) {
            const rank = this.layout.ranks[domain];
            if (rank === undefined)
                throw new Error(`state: expected a domain below ${this.layout.domains}, got ${domain}`);
            if (place + rank > q.length)
                throw new Error(`state: expected ${place + rank} coordinates, got ${q.length}`);
            this.q.set(q.subarray(place, place + rank), at(this.layout.firstCoordinate, domain));
            place += rank;
        }
    }

    private applyOrigins(origins: Float64Array): void {
        if (origins.length === 0) return;
        const { scene, roots } = this.layout;
        const { info } = scene;
        if (origins.length !== 3 && origins.length !== 3 * roots.length) {
            throw new Error(`state: expected 3 or ${3 * roots.length} numbers of origins, got ${origins.length}`);
        }
        roots.forEach((domain, place) => {
            for (let axis = 0; axis < 3; axis++) {
                const world = at(origins, (origins.length === 3 ? 0 : 3 * place) + axis);
                this.rootOrigins[3 * domain + axis] = (world - (info.origin[axis] ?? 0)) / info.unit;
            }
        });
    }
}

/** A complete state as it arrived. */
export interface EncodedState {
    head: StateHead;
    data: Uint8Array;
}

/** Joins the chunks of states. */
export class StateAssembler {
    private head: StateHead | null = null;
    private data: Uint8Array = new Uint8Array();
    private received = 0;

    /** The state that this chunk completes, or null. */
    add(chunk: StateChunk): EncodedState | null {
        if (chunk.head) {
            this.head = chunk.head;
            this.received = 0;
            const total = Number(chunk.head.total);
            this.data = chunk.data.length === total ? chunk.data : new Uint8Array(total);
        }
        if (!this.head) throw new Error("state: expected a head in the first chunk, got none");
        if (Number(chunk.offset) !== this.received || this.received + chunk.data.length > this.data.length) {
            throw new Error(`state: expected a chunk at ${this.received}, got ${chunk.offset}`);
        }
        if (this.data !== chunk.data) this.data.set(chunk.data, this.received);
        this.received += chunk.data.length;
        if (this.received < this.data.length) return null;
        const state = { head: this.head, data: this.data };
        this.head = null;
        return state;
    }
}
