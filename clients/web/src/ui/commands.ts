/** The commands of the viewer, as buttons and keys. */

import { Toolbar } from "./toolbar";

/** What the commands do. */
export interface CommandHandlers {
    togglePause(): void;
    /** One step forwards (1) or, in a recording, backwards (-1). */
    step(direction: number): void;
    stepRecording(direction: number): void;
    togglePull(): void;
    frameScene(): void;
    copyCamera(): void;
    togglePictures(): void;
    savePicture(): void;
    toggleVideo(): void;
    nextColor(): void;
    toggleEdges(): void;
    toggleShadows(): void;
    togglePanel(): void;
    toggleHelp(): void;
}

export function createToolbar(handlers: CommandHandlers): Toolbar {
    return new Toolbar([
        [
            { id: "pause", icon: "pause", label: "Pause", key: "Space", run: handlers.togglePause },
            { id: "step", icon: "step", label: "Show one step", key: ".", run: () => handlers.step(1) },
        ],
        [
            {
                id: "pull",
                icon: "pull",
                label: "Pull on the surface",
                key: "P, or Shift + drag",
                run: handlers.togglePull,
                isToggle: true,
            },
            { id: "frame", icon: "frame", label: "Frame the scene", key: "F", run: handlers.frameScene },
            { id: "copy", icon: "copy", label: "Copy the camera as Python", key: "C", run: handlers.copyCamera },
            {
                id: "pictures",
                icon: "picture",
                label: "Server's pictures",
                key: "V",
                run: handlers.togglePictures,
                isToggle: true,
            },
        ],
        [
            { id: "save", icon: "camera", label: "Save a picture", key: "I", run: handlers.savePicture },
            {
                id: "video",
                icon: "video",
                label: "Record a video",
                key: "R",
                run: handlers.toggleVideo,
                isToggle: true,
            },
        ],
        [{ id: "help", icon: "help", label: "Help", key: "?", run: handlers.toggleHelp }],
    ]);
}

/** The commands by `KeyboardEvent.key`; letters are lower case. */
export function keyCommands(handlers: CommandHandlers): Record<string, () => void> {
    return {
        " ": handlers.togglePause,
        ".": () => handlers.step(1),
        ArrowRight: () => handlers.stepRecording(1),
        ArrowLeft: () => handlers.stepRecording(-1),
        p: handlers.togglePull,
        f: handlers.frameScene,
        c: handlers.copyCamera,
        v: handlers.togglePictures,
        i: handlers.savePicture,
        r: handlers.toggleVideo,
        m: handlers.nextColor,
        e: handlers.toggleEdges,
        s: handlers.toggleShadows,
        b: handlers.togglePanel,
        "?": handlers.toggleHelp,
    };
}

export function listenToKeys(handlers: CommandHandlers): void {
    const commands = keyCommands(handlers);
    window.addEventListener("keydown", (event) => {
        const target = event.target as HTMLElement;
        if (event.ctrlKey || event.metaKey || event.altKey) return;
        const isTyping = target.matches?.("input:not([type=checkbox]):not([type=range]), select, textarea");
        const isButton = target.matches?.("button, summary, input");
        if (isTyping || (isButton && (event.key === " " || event.key.startsWith("Arrow")))) return;
        const command = commands[event.key.length === 1 ? event.key.toLowerCase() : event.key];
        if (!command) return;
        event.preventDefault();
        command();
    });
}
