/** The panels that only show: legend, forces, performance, and facts about the scene. */

import type { SceneInfo } from "../proto/modalcast/v1/scenes_pb";
import { meshBytes } from "../render/surfaces";
import type { Viewport } from "../render/viewport";
import { norm, type Vec3 } from "../scene/affine";
import { commonHertz } from "../scene/description";
import { at } from "../scene/numbers";
import type { SceneSession } from "../session";
import { h, setText } from "./dom";
import { FactsTable } from "./facts_table";
import * as format from "./format";
import { Legend } from "./legend";
import { modeName } from "./mode_row";
import type { Panel } from "./panel";
import { isPhone, pullHintText } from "./pull_hint";
import { RateMeter } from "./rate_meter";
import type { Settings } from "./settings";

export class StatusPanels {
    readonly stateRate = new RateMeter();
    readonly byteRate = new RateMeter();
    readonly pictureRate = new RateMeter();
    /** Round trip of the last call in milliseconds. */
    latency = 0;
    /** Seconds of the motion per second of real time; null if unknown. */
    timeScale: number | null = null;
    readonly legend = new Legend();
    private readonly scene = new FactsTable();
    private readonly performance = new FactsTable();
    private readonly forces = h("p", { className: "hint", textContent: "Nobody pulls." });

    constructor(
        private readonly panel: Panel,
        private readonly settings: Settings,
        private readonly viewport: Viewport,
    ) {
        const body = (element: HTMLElement) => h("div", { className: "body" }, element);
        panel.add("Forces", body(this.forces), false);
        panel.add("Performance", body(this.performance.element), false);
        panel.add("Scene", body(this.scene.element), false);
    }

    showScene(info: SceneInfo): void {
        const { bounds, unit } = info;
        const size = [0, 1, 2]
            .map((axis) => format.short((at(bounds, 3 + axis) - at(bounds, axis)) * unit))
            .join(" x ");
        this.scene.set({
            Source: info.source,
            Parts: format.count(info.domains),
            Vertices: format.count(info.vertices),
            Triangles: format.count(info.triangles),
            Modes: format.count(info.coordinates),
            Size: `${size} m`,
            Unit: unit === 1 ? null : `${format.short(unit)} m`,
            "Up axis": info.up,
        });
    }

    update(session: SceneSession): void {
        this.updateLegend(session);
        this.updateForces(session);
        this.updatePerformance(session);
    }

    private updatePerformance({ model, renderer, pictures, source }: SceneSession): void {
        const { settings, viewport } = this;
        const rate = settings.pictures ? this.pictureRate.perSecond() : viewport.framesPerSecond;
        const stages = settings.pictures ? (pictures?.stages ?? []) : model.stages;
        const step = model.state.step;
        const storage = renderer?.deformer.format === "i16" ? "16-bit integers" : "f16";
        this.performance.set({
            "Frames drawn": `${rate.toFixed(0)} /s`,
            "Steps received": `${this.stateRate.perSecond().toFixed(0)} /s`,
            "Steps not shown": format.count(settings.pictures ? (pictures?.skipped ?? 0n) : model.counts.skipped),
            Received: `${format.bytes(this.byteRate.perSecond())}/s`,
            "Bytes of the last step": format.bytes(
                settings.pictures ? (pictures?.lastFrameBytes ?? 0) : model.lastStateBytes,
            ),
            "Round trip": source.server ? `${this.latency.toFixed(1)} ms` : null,
            "Position error": this.errorText({ model, renderer }),
            Pictures: settings.pictures ? (settings.jpeg ? "JPEG, with losses" : "PNG, exact") : null,
            "Storage of modes": renderer && model.layout.coordinates > 0 ? storage : null,
            "Graphics memory": renderer ? format.bytes(renderer.deformer.bytes + meshBytes(model.scene)) : null,
            Step: step ? `${step.number} at ${format.seconds(step.time)}` : "rest state",
            "Time scale": this.timeScale === null ? null : format.timeScale(this.timeScale),
            "Server, per step":
                stages.length > 0
                    ? `${stages.map(({ stage, milliseconds }) => `${stage} ${milliseconds.toFixed(2)}`).join(", ")} ms`
                    : null,
            // The server's ground hides no geometry, so such geometry seems to be in front of the ground.
            "Below the ground":
                settings.pictures && pictures && pictures.belowGround > 0 ? format.meters(pictures.belowGround) : null,
            "Drawn with": settings.pictures ? "pictures of the server" : viewport.rendererName,
        });
    }

    private errorText({ model, renderer }: Pick<SceneSession, "model" | "renderer">): string | null {
        if (this.settings.pictures || !renderer || model.layout.coordinates === 0) return null;
        const bound = renderer.errorBound();
        return bound === 0 ? "none at rest" : `at most ${format.meters(bound)}`;
    }

    private updateLegend({ renderer, colorScale, model }: SceneSession): void {
        const { color, pictures } = this.settings;
        if (pictures || color.kind === "shaded" || !renderer) return this.legend.hide();
        if (color.kind === "displacement") return this.legend.show("Deflection", format.meters(colorScale.end));
        const name = modeName(color.mode, commonHertz(model.scene, color.mode));
        this.legend.show(`${name}: part of its largest deflection`, "100 %");
    }

    private updateForces({ model, pull, modeForces, source }: SceneSession): void {
        this.panel.setCount("Forces", model.forces.length > 0 ? String(model.forces.length) : "");
        if (model.forces.length === 0) {
            const gesture = source.features.forces ? ` ${pullHintText(isPhone())}` : "";
            setText(this.forces, `Nobody pulls.${gesture}`);
            return;
        }
        const text = model.forces.map(({ owner, force }) => {
            const isOwn = owner === pull?.ownerNumber || owner === modeForces?.ownerNumber;
            const newtons = force?.kind.case === "surface" ? norm(force.kind.value.vector as Vec3) : null;
            const limit = (isOwn ? pull?.view?.limit : undefined) ?? null;
            const size =
                newtons === null
                    ? "modes held"
                    : isOwn
                      ? format.limitedNewtons(newtons, limit)
                      : format.newtons(newtons);
            const who = isOwn ? "you" : `viewer ${owner}`;
            return `${who}: ${size} on ${model.scene.domains[force?.domain ?? 0]?.name ?? "?"}`;
        });
        setText(this.forces, text.join("\n"));
    }
}
