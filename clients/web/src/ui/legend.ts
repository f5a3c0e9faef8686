/** The legend of color maps that the browser draws. The server draws its own legend into its pictures. */

import { byId, h, setText } from "./dom";

/** viridis at equal steps: matplotlib's table at 0, 1/4, 1/2, 3/4 and 1. */
const VIRIDIS = ["#440154", "#3b528b", "#21918c", "#5ec962", "#fde725"];

export class Legend {
    private readonly element = byId("legend");
    private readonly title = h("div");
    private readonly end = h("span");

    constructor() {
        const scale = h("div", { className: "scale" });
        scale.style.background = `linear-gradient(90deg, ${VIRIDIS.join(", ")})`;
        this.element.append(
            this.title,
            scale,
            h("div", { className: "ends" }, h("span", { textContent: "0" }), this.end),
        );
    }

    show(title: string, largest: string): void {
        this.element.hidden = false;
        setText(this.title, title);
        setText(this.end, largest);
    }

    hide(): void {
        this.element.hidden = true;
    }

    /**
     * Draws the legend, if it is visible, into the lower left corner of a picture.
     *
     * @param scale Pixels of the picture per CSS pixel.
     */
    paint(context: CanvasRenderingContext2D, scale: number): void {
        if (this.element.hidden) return;
        const [margin, width, bar] = [14, 184, 10];
        context.save();
        context.scale(scale, scale);
        context.translate(margin, context.canvas.height / scale - margin);
        const gradient = context.createLinearGradient(0, 0, width, 0);
        VIRIDIS.forEach((color, index) => gradient.addColorStop(index / (VIRIDIS.length - 1), color));
        context.fillStyle = gradient;
        context.fillRect(0, -16 - bar, width, bar);
        context.fillStyle = "#16202e";
        context.font = "13px system-ui, sans-serif";
        context.fillText(this.title.textContent ?? "", 0, -22 - bar);
        context.fillText("0", 0, 0);
        context.textAlign = "right";
        context.fillText(this.end.textContent ?? "", width, 0);
        context.restore();
    }
}
