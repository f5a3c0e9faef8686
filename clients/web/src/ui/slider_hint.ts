/** What the sliders of modes do, or why there are none, in words for the user. */

import { missingModes } from "../control/pull_problem";
import type { SceneSession } from "../session";

const WITHOUT_PHYSICS = "start `modalcast view` again with `--no-sim` at the end of your command.";

type HintFacts = Pick<SceneSession, "isDriven" | "sliderEffect" | "hasStiffness" | "source"> & {
    model: Pick<SceneSession["model"], "scene">;
    modeForces: { hasReceiver: boolean | null } | null;
};

export function sliderHint({ model, isDriven, sliderEffect, hasStiffness, modeForces, source }: HintFacts): string {
    const { scene } = model;
    if (!source.features.drive) return "";
    if (sliderEffect === "forces")
        return `Physics is running: a slider holds a mode by a constant force. To animate modes, ${WITHOUT_PHYSICS}`;
    if (!isDriven)
        return missingModes(scene) || "No physics is running: sliders set deflections, and a pull has no effect.";
    if (modeForces?.hasReceiver == null) return "Physics is running.";
    if (modeForces.hasReceiver && !hasStiffness)
        return `Physics is running, and modes without eigenvalues cannot be held. To get sliders, ${WITHOUT_PHYSICS}`;
    return "Another program moves this model and accepts no forces. Stop it to get sliders.";
}
