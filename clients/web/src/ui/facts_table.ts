/** A table of names and values in a panel. */

import { h, setText } from "./dom";

export class FactsTable {
    readonly element = h("table", { className: "facts" });
    private readonly cells = new Map<string, { row: HTMLElement; cell: HTMLElement }>();

    /** Sets the values by name; null hides a row. Rows have the order in which they were first set. */
    set(values: Record<string, string | null>): void {
        for (const [name, value] of Object.entries(values)) {
            let entry = this.cells.get(name);
            if (!entry) {
                const cell = h("td");
                const row = h("tr", {}, h("th", { scope: "row", textContent: name }), cell);
                this.element.append(row);
                entry = { row, cell };
                this.cells.set(name, entry);
            }
            entry.row.hidden = value === null;
            if (value !== null) setText(entry.cell, value);
        }
    }
}
