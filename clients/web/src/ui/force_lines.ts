/** The pull of this viewer, and the forces of others or of a recording, as lines over the picture. */

import type { PullView } from "../control/pull";
import { positionOf, surfacePoint } from "../control/surface_point";
import type { OrbitCamera } from "../render/camera";
import { addScaled, norm, subtract, type Vec3 } from "../scene/affine";
import type { SceneSession } from "../session";
import * as format from "./format";
import { Overlay, type OverlayLine } from "./overlay";

/** Length of the line of the largest force so far, as a part of its distance from the camera. */
const LONGEST_LINE = 0.15;

export class ForceLines {
    private readonly overlay = new Overlay();
    private session: SceneSession | null = null;
    /** Newtons of the largest force so far or, in a recording, of all: the lengths of all lines are proportional. */
    largest = 0;

    /** Shows the forces of another scene. */
    setSession(session: SceneSession | null): void {
        this.session = session;
        this.largest = 0;
        this.overlay.draw([]);
    }

    draw(camera: OrbitCamera): void {
        if (!this.session) return;
        const { model, pull, source, deflections } = this.session;
        const lines: OverlayLine[] = [];
        const add = (from: Vec3, to: Vec3, text: string, isOwn: boolean) => {
            const [start, end] = [camera.project(from), camera.project(to)];
            if (start && end) lines.push({ from: start, to: end, text, isOwn });
        };
        const view = pull?.view;
        if (view && pull?.grabbed) {
            const largest = deflections?.largest(pull.grabbed.domain) ?? null;
            add(view.from, view.to, pullText(view, largest), true);
        }
        for (const { owner, force } of model.forces) {
            if (force?.kind.case !== "surface" || owner === pull?.ownerNumber) continue;
            const { triangle, barycentric, vector } = force.kind.value;
            const point = surfacePoint(model, force.domain, triangle, barycentric);
            const newtons = norm(vector as Vec3);
            if (!point || !(newtons > 0)) continue;
            this.largest = Math.max(this.largest, newtons);
            const from = positionOf(model, point);
            const length = LONGEST_LINE * norm(subtract(camera.eye, from)) * (newtons / this.largest);
            const isOnly = !source.server && model.forces.length === 1;
            const text = isOnly ? format.newtons(newtons) : `viewer ${owner}: ${format.newtons(newtons)}`;
            // A recording is not pulled, so its forces are drawn like a pull.
            add(from, addScaled(from, vector as Vec3, length / newtons), text, !source.server);
        }
        this.overlay.draw(lines);
    }
}

/**
 * The force and its limit, deflections of the point and of the part, and the reason for the limit if it is reached.
 *
 * @param largest Largest deflection of the part in meters; null if it is unknown.
 */
function pullText({ newtons, limit, deflection, isLimited, limitReason }: PullView, largest: number | null): string {
    const lines = [format.limitedNewtons(newtons, limit), `${format.meters(deflection)} at the pulled point`];
    if (largest !== null) lines.push(`${format.meters(largest)} largest`);
    if (isLimited) lines.push(limitReason);
    return lines.join("\n");
}
