/** Arrows and texts over the picture: the pull of this viewer, and the forces of others. */

import { byId } from "./dom";

export interface OverlayLine {
    from: [number, number];
    to: [number, number];
    /** "\n" separates its lines. */
    text: string;
    isOwn: boolean;
}

const SVG = "http://www.w3.org/2000/svg";

/** Pixels between two lines of a text. */
const LINE_HEIGHT = 17;

/** Pixels between a text and the right edge of the view. */
const MARGIN = 8;

/** Height in pixels that the bar may cover. A text that would be in this area is placed below its arrow. */
const TOP = 60;

/** Length and half width of an arrow's head in pixels. */
const HEAD = [13, 6] as const;

export class Overlay {
    private readonly svg = byId<SVGSVGElement>("overlay");

    draw(lines: readonly OverlayLine[]): void {
        if (lines.length === 0 && !this.svg.firstChild) return;
        this.svg.replaceChildren(...lines.flatMap((line) => this.elements(line)));
        const width = this.svg.clientWidth - MARGIN;
        for (const label of this.svg.querySelectorAll("text")) {
            const box = label.getBBox();
            label.setAttribute("transform", `translate(${Math.min(0, width - box.x - box.width)} 0)`);
        }
    }

    private elements({ from, to, text, isOwn }: OverlayLine): SVGElement[] {
        const create = (tag: string, attributes: Record<string, string | number>) => {
            const element = document.createElementNS(SVG, tag);
            for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
            return element as SVGElement;
        };
        const [x1, y1] = from;
        const [x2, y2] = to;
        const owner = isOwn ? "own" : "other";
        const line = create("line", { x1, y1, x2, y2, class: owner });
        const point = create("circle", { cx: x1, cy: y1, r: 5, class: owner });
        const head = create("polygon", { points: arrowHead(from, to), class: owner });
        const parts = text.split("\n");
        const above = y2 - 10 - LINE_HEIGHT * (parts.length - 1);
        const label = create("text", { y: above - LINE_HEIGHT < TOP ? y2 + 26 : above });
        parts.forEach((part, index) => {
            const span = create("tspan", { x: x2 + 12, dy: index > 0 ? LINE_HEIGHT : 0 });
            span.textContent = part;
            label.append(span);
        });
        return [line, point, head, label];
    }
}

/** The corners of an arrow's head; none if the arrow is too short for it. */
function arrowHead([x1, y1]: [number, number], [x2, y2]: [number, number]): string {
    const length = Math.hypot(x2 - x1, y2 - y1);
    if (length < 2 * HEAD[0]) return "";
    const [dx, dy] = [(x2 - x1) / length, (y2 - y1) / length];
    const [x, y] = [x2 - HEAD[0] * dx, y2 - HEAD[0] * dy];
    const side = (sign: number) => `${x - sign * HEAD[1] * dy},${y + sign * HEAD[1] * dx}`;
    return `${x2},${y2} ${side(1)} ${side(-1)}`;
}
