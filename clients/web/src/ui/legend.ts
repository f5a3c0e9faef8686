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
}
