/** The viewer: connects the scene, the drawing, the panels and the tools. */

import { budgetProblem } from "./budget";
import type { PictureView } from "./control/picture_view";
import type { PullTool } from "./control/pull";
import { PullGesture } from "./control/pull_gesture";
import { pullProblem } from "./control/pull_problem";
import { positionOf, type SurfacePoint } from "./control/surface_point";
import { Output } from "./proto/modalcast/v1/frames_pb";
import { cssColor, lightingOf } from "./render/lighting";
import type { SceneRenderer } from "./render/scene_renderer";
import { Viewport } from "./render/viewport";
import type { Vec3 } from "./scene/affine";
import type { SceneArrays } from "./scene/arrays";
import type { SceneDescription } from "./scene/description";
import { SceneModel } from "./scene/scene_model";
import { TimeScale } from "./scene/time_scale";
import { SceneSession, type SceneSource } from "./session";
import type { Playback } from "./source/playback";
import type { PictureOptions } from "./source/server";
import { AxesGizmo } from "./ui/axes_gizmo";
import { Bar } from "./ui/bar";
import { Capture } from "./ui/capture";
import { type CommandHandlers, createToolbar, listenToKeys } from "./ui/commands";
import { CoordinateSection } from "./ui/coordinate_section";
import { Cover } from "./ui/cover";
import { coveredHeights } from "./ui/covered_heights";
import { byId } from "./ui/dom";
import { DomainSection } from "./ui/domain_section";
import { ForceLines } from "./ui/force_lines";
import * as format from "./ui/format";
import { Help } from "./ui/help";
import { Notices } from "./ui/notices";
import { Panel } from "./ui/panel";
import { PullHint } from "./ui/pull_hint";
import { RemarksSection } from "./ui/remarks";
import { ScaleBar } from "./ui/scale_bar";
import { defaultSettings } from "./ui/settings";
import { sliderHint } from "./ui/slider_hint";
import { StatusPanels } from "./ui/status_panels";
import type { Toolbar } from "./ui/toolbar";
import { ViewSection } from "./ui/view_section";

/** Milliseconds between two updates of the panel of modes. */
const COORDINATES_MS = 60;

export class App implements CommandHandlers {
    private readonly stage = byId("stage");
    private readonly picture = byId<HTMLCanvasElement>("picture");
    readonly viewport = new Viewport(this.stage, byId<HTMLCanvasElement>("surface"));
    readonly bar = new Bar();
    readonly cover = new Cover();
    readonly notices = new Notices();
    readonly settings = defaultSettings();
    readonly status: StatusPanels;
    private readonly pullHint = new PullHint(this.notices);
    private readonly remarks: RemarksSection;
    private readonly toolbar: Toolbar;
    private readonly capture: Capture;
    private readonly panel = new Panel();
    private readonly help = new Help();
    private readonly view = new ViewSection(this.settings);
    private readonly coordinates: CoordinateSection;
    private readonly domains = new DomainSection();
    private readonly forceLines = new ForceLines();
    private readonly axes = new AxesGizmo((toCamera) => this.viewport.camera.lookAlong(toCamera));
    private readonly scaleBar = new ScaleBar();
    private readonly pullGesture = new PullGesture(this.stage);
    session: SceneSession | null = null;
    /** The recording that is shown; null for a server. */
    playback: Playback | null = null;
    private isPaused = false;
    private showsOneStep = false;
    /** Whether the panel of modes does not show the state of the view yet, and when it was updated. */
    private hasNewState = false;
    private lastCoordinates = -Infinity;
    private driveHint = "";
    private framedScene = "";
    private timeScale = new TimeScale();

    constructor() {
        this.coordinates = new CoordinateSection({
            set: (domain, mode, value) => {
                const { session } = this;
                if (session?.sliderEffect === "forces") session.modeForces?.set(domain, mode, value);
                else session?.driver?.set(domain, mode, value);
            },
            animate: (...mode) => this.session?.driver?.animate(...mode),
            stop: () => this.session?.driver?.stopAnimation(),
            reset: (domain) => {
                const { session } = this;
                if (session?.sliderEffect === "forces") session.modeForces?.reset(domain);
                else session?.driver?.reset(domain);
            },
            canHold: (domain, mode) => this.session?.modeForces?.canHold(domain, mode) ?? false,
            target: (domain, mode) => this.session?.modeForces?.target(domain, mode) ?? 0,
        });
        this.remarks = new RemarksSection(this.panel, this.notices);
        this.panel.add("View", this.view.element, true);
        this.panel.add("Modes", this.coordinates.element, true);
        this.panel.add("Parts", this.domains.element, false);
        this.status = new StatusPanels(this.panel, this.settings, this.viewport);
        this.capture = new Capture(this.viewport, this.status.legend, this.notices);
        this.toolbar = createToolbar(this);
        this.capture.onRecording = (isRecording) => this.toolbar.setPressed("video", isRecording);
        listenToKeys(this);
        this.connectEvents();
        if (window.innerWidth <= 720) this.panel.isOpen = false;
        setInterval(() => this.updatePanels(), 250);
    }

    get model(): SceneModel | null {
        return this.session?.model ?? null;
    }

    get renderer(): SceneRenderer | null {
        return this.session?.renderer ?? null;
    }

    get pictures(): PictureView | null {
        return this.session?.pictures ?? null;
    }

    get pull(): PullTool | null {
        return this.session?.pull ?? null;
    }

    /** Current position of a point of the surface, in scene units relative to the scene's origin. */
    positionOf(point: SurfacePoint | null): Vec3 | null {
        return this.model && point ? positionOf(this.model, point) : null;
    }

    /** Lets the keys control a recording, whose time line replaces the buttons for live steps. */
    setPlayback(playback: Playback | null): void {
        this.playback = playback;
        this.forceLines.largest = playback?.largestForce ?? 0;
        for (const id of ["pause", "step", "pull", "pictures"]) this.toolbar.setVisible(id, playback === null);
    }

    /** Empty if this browser can draw the scene within its limits; otherwise the reason, for the user. */
    drawingProblem(scene: SceneDescription): string {
        const { gl, rendererName } = this.viewport;
        return gl ? budgetProblem(scene) : `This browser cannot draw the scene: ${rendererName}.`;
    }

    /** Shows a scene. `arrays` is null if the server draws it, with the reason as `hint`. */
    showScene(scene: SceneDescription, arrays: SceneArrays | null, hint: string, source: SceneSource): SceneModel {
        this.closeScene();
        const { viewport, settings } = this;
        const model = new SceneModel(scene, arrays);
        const session = new SceneSession(model, source, viewport, this.picture);
        this.session = session;
        this.timeScale = new TimeScale();
        const { renderer } = session;
        if (renderer) {
            renderer.setOptions(settings);
            renderer.update(model.state);
            viewport.setScene(renderer);
        } else settings.pictures = true;
        if (renderer && !source.features.pictures) settings.pictures = false;
        this.view.restrict(renderer !== null, source.features.pictures, hint);
        this.view.setBackground(lightingOf(scene));
        this.view.setModes(scene.shapes.reduce((largest, shape) => Math.max(largest, shape.rank), 0));
        this.domains.setScene(scene);
        this.panel.setCount("Parts", format.count(scene.domains.length));
        this.status.showScene(scene.info);
        this.remarks.set(scene.info);
        this.frameOnce(scene);
        this.connectSession(session);
        this.coordinates.setScene(model, session.deflections);
        this.forceLines.setSession(session);
        this.cover.hide();
        document.title = `${scene.info.scene} - modalcast`;
        this.applySettings();
        return model;
    }

    /** Breaks the connection, for tests; the viewer connects again. */
    disconnect(): void {
        this.session?.source.server?.channel.close();
    }

    closeScene(): void {
        this.session?.close();
        this.session = null;
        this.viewport.setScene(null);
        this.driveHint = "";
        this.notices.hide("receiver");
        this.remarks.set(null);
        this.bar.setTimeScale("");
        this.forceLines.setSession(null);
        this.pullHint.update(false);
    }

    /** Changes the settings, and applies them. */
    change(apply: () => void): void {
        apply();
        this.view.refresh();
        this.applySettings();
    }

    // The commands are properties, because buttons and keys call them as functions.

    togglePause = (): void => {
        if (this.playback) return this.playback.toggle();
        this.isPaused = !this.isPaused;
        this.toolbar.setIcon("pause", this.isPaused ? "play" : "pause", this.isPaused ? "Play" : "Pause");
        if (!this.isPaused && this.session) {
            this.renderer?.update(this.session.model.state);
            this.viewport.invalidate();
        }
    };

    step = (direction: number): void => {
        if (this.playback) return this.playback.step(direction);
        if (!this.isPaused) this.togglePause();
        this.showsOneStep = true;
    };

    stepRecording = (direction: number): void => this.playback?.step(direction);

    togglePull = (): void => {
        const { pullGesture } = this;
        pullGesture.isActive = !pullGesture.isActive;
        this.toolbar.setPressed("pull", pullGesture.isActive);
        this.stage.classList.toggle("pull", pullGesture.isActive);
    };

    frameScene = (): void => this.viewport.camera.frame();

    copyCamera = async (): Promise<void> => {
        const text = this.viewport.camera.toPython();
        try {
            await navigator.clipboard.writeText(text);
            this.notices.show("copy", `Copied: ${text}`);
        } catch {
            // Pages without TLS have no clipboard, except on the loopback address.
            this.notices.show("copy", text, { duration: 0 });
        }
    };

    togglePictures = (): void => {
        if (!this.session?.source.features.pictures || !this.renderer) return;
        this.change(() => (this.settings.pictures = !this.settings.pictures));
    };

    savePicture = (): void => void this.capture.savePicture(this.fileName);

    toggleVideo = (): void => void this.capture.toggleVideo(this.fileName);

    /** Name of saved files, without extension. */
    private get fileName(): string {
        return this.model?.scene.info.scene ?? "modalcast";
    }

    nextColor = (): void => {
        if (!this.model || this.model.layout.coordinates === 0) return;
        this.change(() => this.view.nextColor());
    };

    toggleEdges = (): void => this.change(() => (this.settings.edges = !this.settings.edges));

    toggleShadows = (): void => this.change(() => (this.settings.shadows = !this.settings.shadows));

    togglePanel = (): void => {
        this.panel.isOpen = !this.panel.isOpen;
    };

    toggleHelp = (): void => this.help.toggle();

    private connectSession(session: SceneSession): void {
        const { model, pictures, pull, driver, modeForces } = session;
        model.onState = () => this.onState(session);
        model.onForces = () => {
            this.viewport.invalidate();
            const text = model.receiverError && pullProblem(model.scene, model.receiverError, location.origin);
            this.notices.show("receiver", text, { severity: "warn", duration: 0 });
        };
        if (pictures) {
            pictures.onFrame = () => {
                this.status.pictureRate.add(1);
                this.forceLines.draw(this.viewport.camera);
            };
            pictures.onError = (message) =>
                this.notices.show("pictures", `The server's pictures ended: ${message}`, { severity: "bad" });
        }
        if (pull) {
            pull.onChange = () => {
                if (pull.grabbed) this.pullHint.end();
                this.viewport.invalidate();
            };
            pull.onMessage = (message) => this.notices.show("pull", message, { severity: "warn" });
        }
        if (modeForces) modeForces.onMessage = (message) => this.notices.show("hold", message, { severity: "warn" });
        if (driver) {
            driver.onStatus = (status) => {
                this.driveHint = status.kind === "refused" ? status.message : "";
                if (status.kind === "refused") this.notices.show("drive", status.message, { severity: "warn" });
                this.coordinates.setAnimated(driver.isAnimating);
            };
        }
    }

    private onState(session: SceneSession): void {
        const { model, renderer } = session;
        this.status.stateRate.add(1);
        this.status.byteRate.add(model.lastStateBytes);
        session.receiveState();
        const isOwn = model.state.step?.run === session.driver?.run;
        if (model.state.step && !isOwn) this.timeScale.add(model.state.step, performance.now());
        if (this.isPaused && !this.showsOneStep) return;
        this.showsOneStep = false;
        this.hasNewState = true;
        // A step that changes nothing has no bytes.
        if (model.lastStateBytes === 0) return;
        if (!this.settings.pictures) renderer?.update(model.state);
        this.fitColorScale(session);
        this.viewport.invalidate();
    }

    private fitColorScale({ colorScale, renderer, pictures }: SceneSession): void {
        if (!colorScale.update(performance.now())) return;
        renderer?.setColorScale(colorScale.end);
        if (this.settings.pictures) pictures?.start(this.pictureOptions());
        this.viewport.invalidate();
    }

    /** Frames a scene, unless the camera has framed it before: after a new connection the view stays. */
    private frameOnce(scene: SceneDescription): void {
        const { camera } = this.viewport;
        const { eye, target, hasMoved } = camera;
        camera.setScene(scene);
        if (this.framedScene === scene.info.scene && hasMoved) camera.look(eye, target);
        this.framedScene = scene.info.scene;
    }

    private applySettings(): void {
        const { settings, viewport, session } = this;
        this.picture.hidden = !settings.pictures;
        byId("surface").hidden = settings.pictures;
        if (session?.renderer && !settings.pictures) {
            session.renderer.setOptions(settings);
            session.renderer.update(session.model.state);
        }
        // Behind the corners of the sheet on a phone.
        document.body.style.background = session?.renderer ? cssColor(session.renderer.backgroundColor) : "";
        session?.colorScale.select(settings.color, performance.now());
        session?.renderer?.setColorScale(session.colorScale.end);
        if (settings.pictures) session?.pictures?.start(this.pictureOptions());
        else session?.pictures?.stop();
        this.capture.followView(this.fileName);
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
            largest: this.session?.colorScale.end ?? 0,
            edges: settings.edges,
        };
    }

    private connectEvents(): void {
        const { viewport, pullGesture } = this;
        this.view.onChange = () => this.applySettings();
        this.domains.onChange = () => {
            this.renderer?.setDisplay({ hidden: this.domains.hidden, highlighted: this.domains.selected });
            viewport.invalidate();
        };
        this.domains.onSelect = (domain) => {
            if (domain !== null) this.coordinates.show(domain);
        };
        this.bar.onPanel = this.togglePanel;
        this.panel.onToggle = (isOpen) => this.bar.setPanelOpen(isOpen);
        viewport.camera.coveredHeights = () => coveredHeights(this.stage);
        viewport.camera.onChange = () => {
            viewport.invalidate();
            if (this.settings.pictures) this.pictures?.moveCamera(viewport.camera.toMessage());
        };
        viewport.onResize = () => {
            if (this.settings.pictures && this.model) this.pictures?.start(this.pictureOptions());
        };
        viewport.onFrame = () => this.drawOverlays();
        viewport.onContextRestored = () => location.reload();
        pullGesture.tool = () => this.pull;
        pullGesture.onMove = () => viewport.invalidate();
        pullGesture.onUnavailable = () =>
            this.notices.show("pull", "There is nobody to pull here: a recording does not react to forces.", {
                severity: "warn",
            });
        this.stage.addEventListener("contextmenu", (event) => event.preventDefault());
    }

    private drawOverlays(): void {
        const { camera } = this.viewport;
        this.forceLines.draw(camera);
        // With the frame that shows the state, so that numbers and picture agree.
        if (this.hasNewState && performance.now() - this.lastCoordinates >= COORDINATES_MS) this.updateCoordinates();
        if (!this.model) return;
        this.axes.draw(camera);
        this.scaleBar.draw(camera.unitsPerPixel * this.model.scene.info.unit);
    }

    private updateCoordinates(): void {
        this.hasNewState = false;
        this.lastCoordinates = performance.now();
        this.coordinates.update(this.pull?.view?.deflection ?? null);
    }

    private updatePanels(): void {
        const { session } = this;
        if (!session) return;
        const { driver, modeForces } = session;
        this.pullHint.update(modeForces?.hasReceiver === true);
        this.coordinates.setEffect(session.sliderEffect, (!session.isDriven && this.driveHint) || sliderHint(session));
        if (!this.isPaused || this.hasNewState) this.updateCoordinates();
        if (!this.isPaused) this.fitColorScale(session);
        if (driver && !driver.isAnimating) this.coordinates.setAnimated(false);
        this.updateTimeScale(session);
        this.status.update(session);
    }

    /** The panel shows every time scale, and the bar those that are at least two times slower or faster than real time. */
    private updateTimeScale(session: SceneSession): void {
        const { driver, isDriven } = session;
        const own = this.playback?.speed ?? driver?.timeScale ?? null;
        const ratio = own ?? this.timeScale.recentRatio(performance.now());
        this.status.timeScale = ratio;
        session.updateModeForces(isDriven ? ratio : null);
        const isVisible = ratio !== null && (ratio <= 0.5 || ratio >= 2);
        this.bar.setTimeScale(isVisible ? format.timeScale(ratio) : "");
    }
}
