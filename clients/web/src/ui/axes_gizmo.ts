/** The axes of the world in a corner of the view. A click on an end of an axis views the scene along it. */

import type { OrbitCamera } from "../render/camera";
import type { Vec3 } from "../scene/affine";
import { byId } from "./dom";

const SVG = "http://www.w3.org/2000/svg";
/** Length of an axis, and radii of the ends with and without a label, in units of the view box. */
const LENGTH = 34;
const RADIUS = 9;
const SMALL_RADIUS = 6;
/** Radius of the clickable area around an end. */
const HIT_RADIUS = 13;

interface AxisEnd {
    direction: Vec3;
    element: SVGGElement;
    line: SVGLineElement;
    /** Towards the viewer, from -1 to 1. */
    depth: number;
}

export class AxesGizmo {
    private readonly svg = byId<SVGSVGElement>("axes");
    private readonly ends: AxisEnd[];

    /** @param lookAlong Views the scene from a direction, which is a unit vector. */
    constructor(lookAlong: (toCamera: Vec3) => void) {
        this.svg.setAttribute("viewBox", "-46 -46 92 92");
        this.ends = ["x", "y", "z"].flatMap((name, axis) =>
            [1, -1].map((sign) => this.createEnd(name, axis, sign, lookAlong)),
        );
    }

    draw(camera: OrbitCamera): void {
        this.svg.removeAttribute("hidden");
        for (const end of this.ends) {
            const [x, y, depth] = camera.directionInView(end.direction);
            end.depth = depth;
            end.element.setAttribute("transform", `translate(${LENGTH * x} ${-LENGTH * y})`);
            end.line.setAttribute("x2", String(-LENGTH * x));
            end.line.setAttribute("y2", String(LENGTH * y));
        }
        // The nearest end is drawn last. Elements move only if their order changes, so that a click is not lost.
        const sorted = [...this.ends].sort((a, b) => a.depth - b.depth).map(({ element }) => element);
        if (sorted.some((element, index) => this.svg.children[index] !== element)) this.svg.replaceChildren(...sorted);
    }

    private createEnd(name: string, axis: number, sign: number, lookAlong: (toCamera: Vec3) => void): AxisEnd {
        const direction = [0, 1, 2].map((index) => (index === axis ? sign : 0)) as Vec3;
        const create = <T extends SVGElement>(tag: string, attributes: Record<string, string | number>): T => {
            const element = document.createElementNS(SVG, tag) as T;
            for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, String(value));
            return element;
        };
        const label = `View from ${sign > 0 ? "+" : "-"}${name}`;
        const element = create<SVGGElement>("g", {
            class: `${name} ${sign > 0 ? "positive" : "negative"}`,
            role: "button",
            tabindex: 0,
            "aria-label": label,
        });
        const line = create<SVGLineElement>("line", {});
        const title = create("title", {});
        title.textContent = label;
        const circle = create("circle", { r: sign > 0 ? RADIUS : SMALL_RADIUS });
        element.append(title, line, create("circle", { r: HIT_RADIUS, class: "hit" }), circle);
        if (sign > 0) {
            const text = create("text", {});
            text.textContent = name;
            element.append(text);
        }
        element.addEventListener("click", () => lookAlong(direction));
        element.addEventListener("keydown", (event) => {
            if (event.key !== "Enter" && event.key !== " ") return;
            event.preventDefault();
            event.stopPropagation();
            lookAlong(direction);
        });
        return { direction, element, line, depth: 0 };
    }
}
