/** Icons as paths of a 24 x 24 grid. */

const PATHS = {
    logo: "M2 15c4-14 6 8 10-3s6 6 10-4",
    play: "M8 5l11 7-11 7z",
    pause: "M8 5v14M16 5v14",
    step: "M6 5l9 7-9 7zM18 5v14",
    pull: "M5 19L16 8M16 8h-6M16 8v6M5 19m-2 0a2 2 0 1 0 4 0a2 2 0 1 0-4 0",
    frame: "M4 9V4h5M15 4h5v5M20 15v5h-5M9 20H4v-5M9 12h6M12 9v6",
    copy: "M9 9h10v11H9zM5 15V4h10",
    picture: "M4 5h16v14H4zM4 16l5-5 4 4 3-3 4 4",
    camera: "M4 8h3l2-3h6l2 3h3v11H4zM12 10a3.500 3.500 0 1 0 0 7a3.500 3.500 0 1 0 0-7",
    video: "M3 7h12v10H3zM15 11l6-3v8l-6-3",
    help: "M9.2 9a3 3 0 1 1 4.3 2.7c-.9.5-1.5 1.100-1.500 2.300M12 17.500v.1M12 3a9 9 0 1 0 0 18a9 9 0 1 0 0-18",
    panel: "M4 5h16v14H4zM15 5v14",
    close: "M6 6l12 12M18 6L6 18",
    wave: "M3 12c3-9 5-9 9 0s6 9 9 0",
    loop: "M17 3l3 3-3 3M20 6H8a4 4 0 0 0-4 4v1M7 21l-3-3 3-3M4 18h12a4 4 0 0 0 4-4v-1",
    eye: "M2 12s4-7 10-7 10 7 10 7-4 7-10 7S2 12 2 12zM12 9a3 3 0 1 0 0 6a3 3 0 1 0 0-6",
} as const;

export type IconName = keyof typeof PATHS;

export function icon(name: IconName): SVGSVGElement {
    const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
    svg.setAttribute("viewBox", "0 0 24 24");
    svg.setAttribute("class", "icon");
    svg.setAttribute("aria-hidden", "true");
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    path.setAttribute("d", PATHS[name]);
    svg.append(path);
    return svg;
}
