/** Lines and texts over the picture: the pull of this viewer, and the forces of others. */

import { byId } from "./dom";

export interface OverlayLine {
    from: [number, number];
    to: [number, number];
    text: string;
    isOwn: boolean;
}

const SVG = "http://www.w3.org/2000/svg";

export class Overlay {
    private readonly svg = byId<SVGSVGElement>("overlay");

    draw(lines: readonly OverlayLine[]): void {
        if (lines.length === 0 && !this.svg.firstChild) return;
        this.svg.replaceChildren(...lines.flatMap((line) => this.elements(line)));
    }

    private elements({ from, to, text, isOwn }: OverlayLine): SVGElement[] {
        const create = (tag: string, attributes: Record<string, string | number>) => {
            const element = document.createElementNS(SVG, tag);
            for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, String(value));
            return element as SVGElement;
        };
        const [x1, y1] = from;
        const [x2, y2] = to;
        const line = create("line", { x1, y1, x2, y2, class: isOwn ? "pull-line" : "other-line" });
        const point = create("circle", { cx: x1, cy: y1, r: 5, class: isOwn ? "" : "other" });
        const label = create("text", { x: x2 + 12, y: y2 - 10 });
        label.textContent = text;
        return [line, point, label];
    }
}
