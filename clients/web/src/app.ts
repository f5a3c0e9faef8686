/** The viewer: connects the scene, the drawing, the panels and the tools. */

import { Driver } from "./control/driver";
import { PictureView } from "./control/picture_view";
import { PullTool } from "./control/pull";
import { positionOf, type SurfacePoint, surfacePoint } from "./control/surface_point";
import { Output } from "./proto/modalcast/v1/frames_pb";
import type { SceneInfo } from "./proto/modalcast/v1/scenes_pb";
import { SceneRenderer } from "./render/scene_renderer";
import { meshBytes } from "./render/surfaces";
import { Viewport } from "./render/viewport";
import { addScaled, norm, type Vec3 } from "./scene/affine";
import type { SceneArrays } from "./scene/arrays";
import { modeBytes, type SceneDescription } from "./scene/description";
import { at } from "./scene/numbers";
import { SceneModel } from "./scene/scene_model";
import type { Playback } from "./source/playback";
import type { PictureOptions, Server } from "./source/server";
import { Bar } from "./ui/bar";
import { CoordinateSection } from "./ui/coordinate_section";
import { Cover } from "./ui/cover";
import { byId, h, setText } from "./ui/dom";
import { DomainSection } from "./ui/domain_section";
import { FactsTable } from "./ui/facts_table";
import * as format from "./ui/format";
import { Help } from "./ui/help";
import { Legend } from "./ui/legend";
import { Notices } from "./ui/notices";
import { Overlay, type OverlayLine } from "./ui/overlay";
import { Panel } from "./ui/panel";
import { RateMeter } from "./ui/rate_meter";
import { defaultSettings } from "./ui/settings";
import { Toolbar } from "./ui/toolbar";
import { ViewSection } from "./ui/view_section";

/** Limits in bytes: on U, stored in 16 bits per entry, and on the merged meshes. Above a limit, the server draws. */
const MODE_BUDGET = 128e6;
const MESH_BUDGET = 512e6;

/** The sliders may drive the scene when another program has sent no step for this many milliseconds. */
const FOREIGN_STEP_MS = 1000;

/** Whether the source of the scene, a server or a recording, draws pictures, accepts forces, and accepts steps. */
export interface SourceFeatures {
    pictures: boolean;
    forces: boolean;
    drive: boolean;
}

export class App {
    readonly viewport = new Viewport(byId("stage"), byId<HTMLCanvasElement>("surface"));
    readonly bar = new Bar();
    readonly cover = new Cover();
    readonly notices = new Notices();
    readonly settings = defaultSettings();
    readonly toolbar: Toolbar;
    private readonly stage = byId("stage");
    private readonly picture = byId<HTMLCanvasElement>("picture");
    private readonly panel = new Panel();
    private readonly help = new Help();
    private readonly legend = new Legend();
    private readonly overlay = new Overlay();
    private readonly view: ViewSection;
    private readonly coordinates: CoordinateSection;
    private readonly domains = new DomainSection();
    private readonly sceneFacts = new FactsTable();
    private readonly performanceFacts = new FactsTable();
    private readonly forceList = h("p", { className: "hint", textContent: "Nobody pulls." });
    readonly stateRate = new RateMeter();
    readonly byteRate = new RateMeter();
    private readonly pictureRate = new RateMeter();

    model: SceneModel | null = null;
    renderer: SceneRenderer | null = null;
    private server: Server | null = null;
    private features: SourceFeatures = { pictures: false, forces: false, drive: false };
    pictures: PictureView | null = null;
    pull: PullTool | null = null;
    private driver: Driver | null = null;
    private pullIsTool = false;
    private paused = false;
    private showOneStep = false;
    private lastForeignStep = -Infinity;
    private hasFirstState = false;
    private driveHint = "";
    private framedScene = "";
    /** Round trip of the last call in milliseconds. */
    latency = 0;
    private playback: Playback | null = null;

    constructor() {
        this.view = new ViewSection(this.settings);
        this.coordinates = new CoordinateSection({
            set: (domain, mode, value) => this.driver?.set(domain, mode, value),
            animate: (domain, mode, amplitude, frequency) => this.driver?.animate(domain, mode, amplitude, frequency),
            stop: () => this.driver?.stopAnimation(),
            reset: (domain) => this.driver?.reset(domain),
        });
        this.panel.add("View", this.view.element, true);
        this.panel.add("Coordinates", this.coordinates.element, true);
        this.panel.add("Domains", this.domains.element, false);
        this.panel.add("Forces", h("div", { className: "body" }, this.forceList), false);
        this.panel.add("Performance", h("div", { className: "body" }, this.performanceFacts.element), true);
        this.panel.add("Scene", h("div", { className: "body" }, this.sceneFacts.element), false);
        this.toolbar = this.createToolbar();
        this.connectEvents();
        if (window.innerWidth <= 720) this.panel.isOpen = false;
        setInterval(() => this.updatePanels(), 250);
    }

    /** Lets the keys control a recording, whose time line replaces the buttons for live steps. */
    setPlayback(playback: Playback | null): void {
        this.playback = playback;
        for (const id of ["pause", "step", "pull", "pictures"]) this.toolbar.setVisible(id, playback === null);
    }

    /** Empty if this browser can draw the scene within its limits; otherwise the reason, for the user. */
    checkBudget(scene: SceneDescription): string {
        if (!this.viewport.gl) return `This browser cannot draw the scene: ${this.viewport.rendererName}.`;
        const modes = modeBytes(scene) / 2;
        const limit = modeBudget();
        if (modes > limit) {
            return `U needs ${format.bytes(modes)} in 16 bits, and the limit is ${format.bytes(limit)}. The server draws this scene.`;
        }
        const meshes = meshBytes(scene);
        if (meshes <= MESH_BUDGET) return "";
        return `The meshes need ${format.bytes(meshes)}, and the limit is ${format.bytes(MESH_BUDGET)}. The server draws this scene.`;
    }

    /** Shows a scene. `arrays` is null if the server draws it. */
    showScene(
        scene: SceneDescription,
        arrays: SceneArrays | null,
        hint: string,
        server: Server | null,
        features: SourceFeatures,
    ): SceneModel {
        this.closeScene();
        const { viewport } = this;
        this.server = server;
        this.features = features;
        const model = new SceneModel(scene, arrays);
        this.model = model;
        if (arrays && viewport.gl) {
            this.renderer = new SceneRenderer(viewport.gl, scene, arrays, viewport.isSoftware);
            this.renderer.setOptions(this.settings);
            this.renderer.update(model.state);
            viewport.setScene(this.renderer);
        }
        if (!this.renderer) this.settings.pictures = true;
        else if (!features.pictures) this.settings.pictures = false;
        this.view.restrict(this.renderer !== null, features.pictures, hint);
        this.view.setModes(scene.shapes.reduce((largest, shape) => Math.max(largest, shape.rank), 0));
        this.domains.setScene(scene);
        this.panel.setCount("Domains", format.count(scene.domains.length));
        this.showSceneFacts(scene.info);
        const keepsCamera = this.framedScene === scene.info.scene;
        const { eye, target } = viewport.camera;
        viewport.camera.setScene(scene);
        if (keepsCamera) viewport.camera.look(eye, target);
        this.framedScene = scene.info.scene;
        this.connectTools(model, server);
        this.coordinates.setScene(
            model,
            (domain) => this.renderer?.deformer.packed[scene.domains[domain]?.shape ?? -1]?.norms ?? null,
        );
        model.onState = () => this.onState();
        model.onForces = () => this.viewport.invalidate();
        this.cover.hide();
        document.title = `${scene.info.scene} - modalcast`;
        this.applySettings();
        return model;
    }

    closeScene(): void {
        this.pull?.end();
        this.pull = null;
        this.driver?.dispose();
        this.driver = null;
        this.pictures?.stop();
        this.pictures = null;
        this.renderer = null;
        this.viewport.setScene(null);
        this.model = null;
        this.hasFirstState = false;
        this.lastForeignStep = -Infinity;
        this.driveHint = "";
        this.overlay.draw([]);
    }

    private connectTools(model: SceneModel, server: Server | null): void {
        if (!server) return;
        const { camera } = this.viewport;
        if (this.features.pictures) {
            const pictures = new PictureView(server, model.scene.info.scene, this.picture);
            pictures.onFrame = () => {
                this.pictureRate.add(1);
                this.drawOverlay();
            };
            pictures.onError = (message) =>
                this.notices.show("pictures", `The server's pictures ended: ${message}`, { severity: "bad" });
            this.pictures = pictures;
        }
        if (this.features.forces) {
            const bounds = model.scene.info.bounds;
            const diagonal = norm([0, 1, 2].map((axis) => at(bounds, 3 + axis) - at(bounds, axis)) as Vec3);
            const pull = new PullTool(server, model, camera, diagonal);
            pull.onChange = () => this.viewport.invalidate();
            pull.onMessage = (message) => this.notices.show("pull", message, { severity: "warn" });
            this.pull = pull;
        }
        if (this.features.drive) {
            const driver = new Driver(server, model);
            driver.onStatus = (status) => {
                this.driveHint = status.kind === "refused" ? status.message : "";
                if (status.kind === "refused") this.notices.show("drive", status.message, { severity: "warn" });
                this.coordinates.setAnimated(driver.isAnimating);
            };
            this.driver = driver;
        }
    }

    private onState(): void {
        const { model, driver } = this;
        if (!model) return;
        this.stateRate.add(1);
        this.byteRate.add(model.lastStateBytes);
        // The first state is sent at once, so it does not show that a program drives the scene.
        if (this.hasFirstState && model.state.step?.run !== driver?.run) this.lastForeignStep = performance.now();
        this.hasFirstState = true;
        this.pull?.update();
        if (this.paused && !this.showOneStep) return;
        this.showOneStep = false;
        // A step that changes nothing has no bytes.
        if (model.lastStateBytes === 0) return;
        if (this.renderer && !this.settings.pictures) this.renderer.update(model.state);
        this.viewport.invalidate();
    }

    private applySettings(): void {
        const { settings, renderer, pictures, viewport } = this;
        this.picture.hidden = !settings.pictures;
        byId("surface").hidden = settings.pictures;
        if (renderer && this.model && !settings.pictures) {
            renderer.setOptions(settings);
            renderer.update(this.model.state);
        }
        if (settings.pictures) pictures?.start(this.pictureOptions());
        else pictures?.stop();
        this.toolbar.setPressed("pictures", settings.pictures);
        viewport.invalidate();
    }

    private pictureOptions(): PictureOptions {
        const { settings, viewport } = this;
        const [width, height] = viewport.pixelSize;
        const outputs = { shaded: Output.COLOR, displacement: Output.DISPLACEMENT, mode: Output.MODE_SHAPE };
        return {
            width,
            height,
            jpeg: settings.jpeg,
            camera: viewport.camera.toMessage(),
            output: outputs[settings.color.kind],
            mode: settings.color.kind === "mode" ? settings.color.mode : 0,
            largest: this.renderer?.colorScale ?? 0,
            edges: settings.edges,
        };
    }

    private connectEvents(): void {
        const { viewport, stage } = this;
        this.view.onChange = () => this.applySettings();
        this.domains.onChange = () => {
            this.renderer?.setDisplay({ hidden: this.domains.hidden, highlighted: this.domains.selected });
            viewport.invalidate();
        };
        this.domains.onSelect = (domain) => {
            if (domain !== null) this.coordinates.show(domain);
        };
        this.bar.onPanel = () => (this.panel.isOpen = !this.panel.isOpen);
        this.panel.onToggle = (isOpen) => this.bar.setPanelOpen(isOpen);
        viewport.camera.onChange = () => {
            viewport.invalidate();
            if (this.settings.pictures) this.pictures?.moveCamera(viewport.camera.toMessage());
        };
        viewport.onResize = () => {
            if (this.settings.pictures && this.model) this.pictures?.start(this.pictureOptions());
        };
        viewport.onFrame = () => this.drawOverlay();
        viewport.onContextRestored = () => location.reload();
        // In the capture phase, before the camera's controls see the event.
        stage.addEventListener("pointerdown", (event) => this.onPointerDown(event), { capture: true });
        stage.addEventListener("contextmenu", (event) => event.preventDefault());
        window.addEventListener("keydown", (event) => this.onKey(event));
    }

    private onPointerDown(event: PointerEvent): void {
        const { pull, stage } = this;
        stage.focus({ preventScroll: true });
        if (event.button !== 0 || !(event.shiftKey || this.pullIsTool)) return;
        event.stopImmediatePropagation();
        if (!pull) {
            this.notices.show("pull", "There is nobody to pull here: a recording does not react to forces.", {
                severity: "warn",
            });
            return;
        }
        const box = stage.getBoundingClientRect();
        const place = (move: PointerEvent): [number, number] => [move.clientX - box.left, move.clientY - box.top];
        stage.setPointerCapture(event.pointerId);
        const move = (next: PointerEvent) => {
            if (next.pointerId !== event.pointerId) return;
            pull.move(...place(next));
            this.viewport.invalidate();
        };
        const end = (last: PointerEvent) => {
            if (last.pointerId !== event.pointerId) return;
            stage.removeEventListener("pointermove", move);
            for (const name of ["pointerup", "pointercancel", "lostpointercapture"] as const)
                stage.removeEventListener(name, end);
            pull.end();
            this.viewport.invalidate();
        };
        stage.addEventListener("pointermove", move);
        for (const name of ["pointerup", "pointercancel", "lostpointercapture"] as const)
            stage.addEventListener(name, end);
        void pull.begin(...place(event), [Math.floor(box.width), Math.floor(box.height)]);
    }

    private createToolbar(): Toolbar {
        return new Toolbar([
            [
                { id: "pause", icon: "pause", label: "Pause", key: "Space", run: () => this.togglePause() },
                { id: "step", icon: "step", label: "Show one step", key: ".", run: () => this.step(1) },
            ],
            [
                {
                    id: "pull",
                    icon: "pull",
                    label: "Pull on the surface",
                    key: "P, or Shift + drag",
                    run: () => this.togglePull(),
                    isToggle: true,
                },
                {
                    id: "frame",
                    icon: "frame",
                    label: "Frame the scene",
                    key: "F",
                    run: () => this.viewport.camera.frame(),
                },
                {
                    id: "copy",
                    icon: "copy",
                    label: "Copy the camera as Python",
                    key: "C",
                    run: () => void this.copyCamera(),
                },
                {
                    id: "pictures",
                    icon: "picture",
                    label: "Server's pictures",
                    key: "V",
                    run: () => this.togglePictures(),
                    isToggle: true,
                },
            ],
            [{ id: "help", icon: "help", label: "Help", key: "?", run: () => this.help.toggle() }],
        ]);
    }

    private onKey(event: KeyboardEvent): void {
        const target = event.target as HTMLElement;
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        const isTyping = target.matches?.("input:not([type=checkbox]):not([type=range]), select, textarea");
        const isButton = target.matches?.("button, summary, input");
        if (isTyping || (isButton && (event.key === " " || event.key.startsWith("Arrow")))) return;
        const actions: Record<string, () => void> = {
            " ": () => this.togglePause(),
            ".": () => this.step(1),
            ArrowRight: () => this.playback?.step(1),
            ArrowLeft: () => this.playback?.step(-1),
            p: () => this.togglePull(),
            f: () => this.viewport.camera.frame(),
            c: () => void this.copyCamera(),
            v: () => this.togglePictures(),
            m: () => this.nextColor(),
            e: () => this.change(() => (this.settings.edges = !this.settings.edges)),
            s: () => this.change(() => (this.settings.shadows = !this.settings.shadows)),
            b: () => (this.panel.isOpen = !this.panel.isOpen),
            "?": () => this.help.toggle(),
        };
        const action = actions[event.key.length === 1 ? event.key.toLowerCase() : event.key];
        if (!action) return;
        event.preventDefault();
        action();
    }

    change(apply: () => void): void {
        apply();
        this.view.refresh();
        this.applySettings();
    }

    private nextColor(): void {
        if (!this.model || this.model.layout.coordinates === 0) return;
        const { settings } = this;
        this.change(() => {
            settings.color = settings.color.kind === "shaded" ? { kind: "displacement" } : { kind: "shaded" };
            this.view.showColor();
        });
    }

    private togglePictures(): void {
        if (!this.features.pictures || !this.renderer) return;
        this.change(() => (this.settings.pictures = !this.settings.pictures));
    }

    private togglePull(): void {
        this.pullIsTool = !this.pullIsTool;
        this.toolbar.setPressed("pull", this.pullIsTool);
        this.stage.classList.toggle("pull", this.pullIsTool);
    }

    togglePause(): void {
        if (this.playback) return this.playback.toggle();
        this.paused = !this.paused;
        this.toolbar.setIcon("pause", this.paused ? "play" : "pause", this.paused ? "Play" : "Pause");
        if (!this.paused && this.model) {
            this.renderer?.update(this.model.state);
            this.viewport.invalidate();
        }
    }

    private step(direction: number): void {
        if (this.playback) return this.playback.step(direction);
        if (!this.paused) this.togglePause();
        this.showOneStep = true;
    }

    private async copyCamera(): Promise<void> {
        const text = this.viewport.camera.toPython();
        try {
            await navigator.clipboard.writeText(text);
            this.notices.show("copy", `Copied: ${text}`);
        } catch {
            // Pages without TLS have no clipboard, except on the loopback address.
            this.notices.show("copy", text, { duration: 0 });
        }
    }

    /** Current position of a point of the surface, in scene units relative to the scene's origin. */
    positionOf(point: SurfacePoint | null): Vec3 | null {
        return this.model && point ? positionOf(this.model, point) : null;
    }

    private drawOverlay(): void {
        const { model, pull, viewport } = this;
        if (!model) return;
        const lines: OverlayLine[] = [];
        const add = (from: Vec3, to: Vec3, text: string, isOwn: boolean) => {
            const [start, end] = [viewport.camera.project(from), viewport.camera.project(to)];
            if (start && end) lines.push({ from: start, to: end, text, isOwn });
        };
        const view = pull?.view;
        if (view) add(view.from, view.to, format.newtons(view.newtons), true);
        for (const { owner, force } of model.forces) {
            if (force?.kind.case !== "surface" || owner === pull?.ownerNumber) continue;
            const { triangle, barycentric, vector } = force.kind.value;
            const point = surfacePoint(model, force.domain, triangle, barycentric);
            if (!point) continue;
            const from = positionOf(model, point);
            const size = norm(vector as Vec3);
            const length = 0.08 * norm(viewport.camera.eye.map((value, axis) => value - at(from, axis)) as Vec3);
            if (size > 0)
                add(
                    from,
                    addScaled(from, vector as Vec3, length / size),
                    `viewer ${owner}: ${format.newtons(size)}`,
                    false,
                );
        }
        this.overlay.draw(lines);
    }

    private updatePanels(): void {
        const { model, renderer, settings } = this;
        if (!model) return;
        const isDriven = performance.now() - this.lastForeignStep < FOREIGN_STEP_MS;
        const canDrive = this.features.drive && !isDriven;
        const driven = isDriven ? "A physics process drives this scene." : this.driveHint;
        this.coordinates.setCanDrive(canDrive, this.features.drive ? driven : "");
        this.coordinates.update();
        if (this.driver && !this.driver.isAnimating) this.coordinates.setAnimated(false);
        this.updateLegend();
        this.updateForces(model);
        const { skipped } = model.counts;
        const rate = settings.pictures ? this.pictureRate.perSecond() : this.viewport.framesPerSecond;
        const stages = settings.pictures ? (this.pictures?.stages ?? []) : model.stages;
        const step = model.state.step;
        this.performanceFacts.set({
            "Frames drawn": `${rate.toFixed(0)} /s`,
            "Steps received": `${this.stateRate.perSecond().toFixed(0)} /s`,
            "Steps skipped": format.count(settings.pictures ? (this.pictures?.skipped ?? 0n) : skipped),
            Received: `${format.bytes(this.byteRate.perSecond())}/s`,
            "Bytes of the last step": settings.pictures
                ? format.bytes(this.pictures?.lastFrameBytes ?? 0)
                : format.bytes(model.lastStateBytes),
            "Round trip": this.server ? `${this.latency.toFixed(1)} ms` : null,
            "Error of this view": this.errorText(),
            "Storage of U":
                renderer && model.layout.coordinates > 0
                    ? renderer.deformer.format === "i16"
                        ? "16-bit integers"
                        : "f16"
                    : null,
            "Graphics memory": renderer ? format.bytes(renderer.deformer.bytes + meshBytes(model.scene)) : null,
            Step: step ? `${step.number} at ${format.seconds(step.time)}` : "rest state",
            Stages:
                stages.length > 0
                    ? `${stages.map(({ stage, milliseconds }) => `${stage} ${milliseconds.toFixed(2)}`).join(", ")} ms`
                    : null,
            "Drawn with": settings.pictures ? "pictures of the server" : this.viewport.rendererName,
        });
    }

    private errorText(): string | null {
        const { renderer, settings } = this;
        if (settings.pictures) return settings.jpeg ? "JPEG" : "none (PNG)";
        if (!renderer || !this.model || this.model.layout.coordinates === 0) return null;
        return `at most ${format.meters(renderer.errorBound())}`;
    }

    private updateLegend(): void {
        const { settings, renderer } = this;
        if (settings.pictures || settings.color.kind === "shaded" || !renderer) return this.legend.hide();
        const isMode = settings.color.kind === "mode";
        const title =
            settings.color.kind === "mode" ? `Mode ${settings.color.mode + 1}, per unit of q` : "Displacement";
        const scale = renderer.colorScale;
        this.legend.show(title, isMode ? `${format.short(scale)} m` : format.meters(scale));
    }

    private updateForces(model: SceneModel): void {
        this.panel.setCount("Forces", model.forces.length > 0 ? String(model.forces.length) : "");
        if (model.forces.length === 0) {
            setText(this.forceList, this.features.forces ? "Nobody pulls. Drag with Shift to pull." : "Nobody pulls.");
            return;
        }
        const text = model.forces.map(({ owner, force }) => {
            const size =
                force?.kind.case === "surface" ? format.newtons(norm(force.kind.value.vector as Vec3)) : "modal";
            const who = owner === this.pull?.ownerNumber ? "you" : `viewer ${owner}`;
            return `${who}: ${size} on ${model.scene.domains[force?.domain ?? 0]?.name ?? "?"}`;
        });
        setText(this.forceList, text.join("\n"));
    }

    private showSceneFacts(info: SceneInfo): void {
        const { bounds, unit } = info;
        const size = [0, 1, 2]
            .map((axis) => format.short((at(bounds, 3 + axis) - at(bounds, axis)) * unit))
            .join(" x ");
        this.sceneFacts.set({
            Source: info.source,
            Domains: format.count(info.domains),
            Vertices: format.count(info.vertices),
            Triangles: format.count(info.triangles),
            Coordinates: format.count(info.coordinates),
            Size: `${size} m`,
            Unit: unit === 1 ? null : `${format.short(unit)} m`,
            "Up axis": info.up,
            Remarks: info.remarks.length > 0 ? info.remarks.join("; ") : null,
        });
    }
}

/** The limit on U; `#u_budget=BYTES` in the address sets another one. */
function modeBudget(): number {
    const value = Number(new URLSearchParams(location.hash.slice(1)).get("u_budget") ?? Number.NaN);
    return value >= 0 ? value : MODE_BUDGET;
}
