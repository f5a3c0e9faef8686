/** Remarks of the loader on the files of a scene: a section of the panel, and a message when the scene is shown. */

import { viewCommand } from "../control/pull_problem";
import type { SceneInfo } from "../proto/modalcast/v1/scenes_pb";
import { h, setMarkedText } from "./dom";
import type { Notices } from "./notices";
import type { Panel } from "./panel";

const TITLE = "Notes on files";
const TOPIC = "remarks";
/** Milliseconds until the message disappears. */
const NOTICE_MS = 12_000;

type Remarked = Pick<SceneInfo, "remarks" | "source" | "unit">;

/** The remarks. One on the size of the model names the command that opens it in another unit. */
export function remarkTexts(info: Remarked): string[] {
    return info.remarks.map((remark) => {
        const [, size, advice = ""] = /^the scene is (.*? m); if its file is (.*)/.exec(remark) ?? [];
        if (size === undefined) return remark;
        if (advice.startsWith("in millimeters"))
            return `The model is ${size} large. If its file is in millimeters: \`${viewCommand(info, "")}\``;
        const command = viewCommand(info, "--unit UNIT");
        return `The model is ${size} large. If its file is not in meters: \`${command}\`, where UNIT is mm, cm, um, in or ft.`;
    });
}

/** The message on remarks: the only one, or the number of remarks. Empty without remarks. */
export function remarkNotice(info: Remarked): string {
    const [first = "", ...others] = remarkTexts(info);
    return others.length > 0 ? `${info.remarks.length} notes on the files of this scene.` : first;
}

export class RemarksSection {
    private readonly list = h("ul", { className: "remarks" });

    constructor(
        private readonly panel: Panel,
        private readonly notices: Notices,
    ) {
        panel.add(TITLE, h("div", { className: "body" }, this.list), false);
        panel.setVisible(TITLE, false);
    }

    /** Shows the remarks of a scene; null, or a scene without any, hides the section and the message. */
    set(info: Remarked | null): void {
        const remarks = info ? remarkTexts(info) : [];
        const items = remarks.map((remark) => {
            const item = h("li");
            setMarkedText(item, remark);
            return item;
        });
        this.list.replaceChildren(...items);
        this.panel.setVisible(TITLE, remarks.length > 0);
        this.panel.setCount(TITLE, String(remarks.length));
        this.notices.show(TOPIC, info ? remarkNotice(info) : "", {
            severity: "warn",
            duration: NOTICE_MS,
            action: { label: "Show", run: () => this.reveal() },
        });
    }

    private reveal(): void {
        this.panel.reveal(TITLE);
        this.notices.hide(TOPIC);
    }
}
