/** The buttons below the view. */

import { byId, h } from "./dom";
import { type IconName, icon } from "./icons";

export interface ToolAction {
    id: string;
    icon: IconName;
    /** Name and key for the tooltip. */
    label: string;
    key: string;
    run: () => void;
    isToggle?: boolean;
}

export class Toolbar {
    private readonly buttons = new Map<string, HTMLButtonElement>();
    readonly element: HTMLElement;

    /** @param groups Groups of buttons, with a separator between two groups. */
    constructor(groups: ToolAction[][]) {
        this.element = h("div", { id: "tools", className: "card", aria: { role: "toolbar", label: "Tools" } });
        groups.forEach((group, index) => {
            if (index > 0) this.element.append(h("span", { className: "separator" }));
            for (const action of group) this.element.append(this.button(action));
        });
        byId("dock").append(this.element);
    }

    setPressed(id: string, isPressed: boolean): void {
        this.buttons.get(id)?.setAttribute("aria-pressed", String(isPressed));
    }

    setIcon(id: string, name: IconName, label: string): void {
        const button = this.buttons.get(id);
        if (!button || button.title.startsWith(label)) return;
        button.replaceChildren(icon(name));
        button.setAttribute("aria-label", label);
        button.title = label;
    }

    setEnabled(id: string, isEnabled: boolean): void {
        const button = this.buttons.get(id);
        if (button) button.disabled = !isEnabled;
    }

    setVisible(id: string, isVisible: boolean): void {
        const button = this.buttons.get(id);
        if (button) button.hidden = !isVisible;
        this.updateSeparators();
    }

    /** Hides each separator that has no visible button before it since the previous separator. */
    private updateSeparators(): void {
        let hasButton = false;
        for (const child of this.element.children as HTMLCollectionOf<HTMLElement>) {
            if (child.className !== "separator") hasButton ||= !child.hidden;
            else {
                child.hidden = !hasButton;
                hasButton = false;
            }
        }
    }

    private button({ id, icon: name, label, key, run, isToggle }: ToolAction): HTMLButtonElement {
        const properties = { className: "icon", title: `${label} (${key})`, aria: { label }, data: { id } };
        const button = h("button", properties, icon(name));
        if (isToggle) button.setAttribute("aria-pressed", "false");
        button.onclick = run;
        this.buttons.set(id, button);
        return button;
    }
}
