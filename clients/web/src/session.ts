/** A scene that is shown, with the parts that live as long as it: drawing, pictures, pulls and steps of this viewer. */

import { Driver } from "./control/driver";
import { ModeForces } from "./control/mode_forces";
import { PictureView } from "./control/picture_view";
import { PullTool } from "./control/pull";
import { ColorScale } from "./render/color_scale";
import { SceneRenderer } from "./render/scene_renderer";
import type { Viewport } from "./render/viewport";
import { norm, type Vec3 } from "./scene/affine";
import { Deflections } from "./scene/deflection";
import { lowestHertz } from "./scene/description";
import { at } from "./scene/numbers";
import type { SceneModel } from "./scene/scene_model";
import type { Server } from "./source/server";

/** The sliders may drive the scene when another program has sent no step for this many milliseconds. */
const FOREIGN_STEP_MS = 1000;

/** Held modes are released when another program has sent no step for this many milliseconds. */
const RELEASE_MS = 3000;

/** How sliders act: by steps of this viewer, by forces on the physics process, or not at all. */
export type SliderEffect = "steps" | "forces" | "none";

/** Whether the source of a scene, a server or a recording, draws pictures, accepts forces, and accepts steps. */
export interface SourceFeatures {
    pictures: boolean;
    forces: boolean;
    drive: boolean;
}

/** Where a scene comes from. */
export interface SceneSource {
    /** Null for a recording. */
    server: Server | null;
    features: SourceFeatures;
}

export class SceneSession {
    /** Null if the server draws the scene. */
    readonly renderer: SceneRenderer | null;
    readonly pictures: PictureView | null;
    readonly pull: PullTool | null;
    readonly driver: Driver | null;
    readonly modeForces: ModeForces | null;
    /** Whether some mode has stiffness. */
    readonly hasStiffness: boolean;
    /** Null without the arrays of the scene. */
    readonly deflections: Deflections | null;
    readonly colorScale: ColorScale;
    private hasFirstState = false;
    private lastForeignStep = -Infinity;

    /** @param canvas The element for the server's pictures. */
    constructor(
        readonly model: SceneModel,
        readonly source: SceneSource,
        viewport: Viewport,
        canvas: HTMLCanvasElement,
    ) {
        const { scene, arrays } = model;
        const { server, features } = source;
        this.hasStiffness = lowestHertz(scene) > 0;
        this.deflections = arrays && new Deflections(model, arrays);
        this.colorScale = new ColorScale(this.deflections, diagonal(model) * scene.info.unit);
        this.renderer =
            arrays && viewport.gl ? new SceneRenderer(viewport.gl, scene, arrays, viewport.isSoftware) : null;
        this.pictures = server && features.pictures ? new PictureView(server, scene.info.scene, canvas) : null;
        this.pull =
            server && features.forces
                ? new PullTool(server, model, viewport.camera, diagonal(model), this.deflections)
                : null;
        this.driver = server && features.drive ? new Driver(server, model) : null;
        this.modeForces = server && features.forces ? new ModeForces(server, model) : null;
    }

    /** Call after each state. */
    receiveState(): void {
        const { model, driver } = this;
        // The first state is sent at once, so it does not show that a program drives the scene.
        if (this.hasFirstState && model.state.step?.run !== driver?.run) this.lastForeignStep = performance.now();
        this.hasFirstState = true;
    }

    /** Whether another program drives the scene. */
    get isDriven(): boolean {
        return performance.now() - this.lastForeignStep < FOREIGN_STEP_MS;
    }

    get sliderEffect(): SliderEffect {
        // Also while a busy page receives no steps for a moment, see `updateModeForces`.
        if (this.modeForces?.hasReceiver && this.hasStiffness) return "forces";
        return this.driver && !this.isDriven ? "steps" : "none";
    }

    /** Call regularly. `timeScale`: seconds of the simulation per second of real time; null if unknown. */
    updateModeForces(timeScale: number | null): void {
        const { modeForces } = this;
        if (!modeForces) return;
        modeForces.probes = this.isDriven;
        if (timeScale !== null) modeForces.timeScale = timeScale;
        const isOver = performance.now() - this.lastForeignStep > RELEASE_MS;
        if (isOver && modeForces.hasReceiver !== null) modeForces.clear();
    }

    /** Ends all streams of this scene. The viewport owns and disposes of the renderer. */
    close(): void {
        this.pull?.end();
        this.driver?.dispose();
        this.modeForces?.dispose();
        this.pictures?.stop();
    }
}

function diagonal({ scene }: SceneModel): number {
    const { bounds } = scene.info;
    return norm([0, 1, 2].map((axis) => at(bounds, 3 + axis) - at(bounds, axis)) as Vec3);
}
