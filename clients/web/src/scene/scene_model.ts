/** The scene that is shown. Receives messages from a server or from a recording. */

import type { StageTime } from "../proto/modalcast/v1/common_pb";
import type { AppliedForce, StreamForcesResponse } from "../proto/modalcast/v1/forces_pb";
import type { StreamStatesResponse } from "../proto/modalcast/v1/states_pb";
import type { SceneArrays } from "./arrays";
import type { SceneDescription } from "./description";
import { type EncodedState, SceneState, StateAssembler, StateLayout } from "./state";

export class SceneModel {
    readonly layout: StateLayout;
    readonly state: SceneState;
    forces: readonly AppliedForce[] = [];
    /** Why nothing answers the forces; empty if unknown, see StreamForcesResponse. */
    receiverError = "";
    private readonly assembler = new StateAssembler();
    /** Number of states applied, steps skipped between them, and bytes of all states. */
    readonly counts = { states: 0, skipped: 0n, bytes: 0 };
    lastStateBytes = 0;
    stages: readonly StageTime[] = [];
    /** Called after each state. */
    onState: () => void = () => {};
    onForces: () => void = () => {};

    /** @param arrays Null if the scene is shown by pictures of the server only. */
    constructor(
        readonly scene: SceneDescription,
        readonly arrays: SceneArrays | null,
    ) {
        this.layout = new StateLayout(scene);
        this.state = new SceneState(this.layout);
    }

    receiveState(response: StreamStatesResponse): void {
        if (response.part.case !== "chunk") return;
        const state = this.assembler.add(response.part.value);
        if (state) this.apply(state);
    }

    receiveForces(response: StreamForcesResponse): void {
        this.forces = response.forces;
        this.receiverError = response.receiverError;
        this.onForces();
    }

    clearForces(): void {
        this.forces = [];
        this.onForces();
    }

    private apply({ head, data }: EncodedState): void {
        this.state.apply(head, data);
        this.counts.states++;
        this.counts.skipped += head.skipped;
        this.counts.bytes += data.length;
        this.lastStateBytes = data.length;
        if (head.stages.length > 0) this.stages = head.stages;
        this.onState();
    }
}
