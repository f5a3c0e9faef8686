/** Small helpers for the DOM. */

type Child = Node | string | null | undefined | false;

type Properties<T extends keyof HTMLElementTagNameMap> = Partial<
    Omit<HTMLElementTagNameMap[T], "style" | "dataset" | "children">
> & { aria?: Record<string, string>; data?: Record<string, string>; htmlFor?: string };

/** Creates an element. */
export function h<T extends keyof HTMLElementTagNameMap>(
    tag: T,
    properties: Properties<T> = {},
    ...children: Child[]
): HTMLElementTagNameMap[T] {
    const element = document.createElement(tag);
    const { aria = {}, data = {}, ...rest } = properties;
    Object.assign(element, rest);
    for (const [name, value] of Object.entries(aria))
        element.setAttribute(name === "role" ? name : `aria-${name}`, value);
    Object.assign(element.dataset, data);
    element.append(...children.filter((child): child is Node | string => Boolean(child)));
    return element;
}

/** An element of index.html. */
export function byId<T extends Element = HTMLElement>(id: string): T {
    const element = document.getElementById(id);
    if (!element) throw new Error(`index.html has no element with the id ${id}`);
    return element as unknown as T;
}

const markedTexts = new WeakMap<Element, string>();

/** Sets a text in which backticks enclose commands, only if it differs. */
export function setMarkedText(element: Element, text: string): void {
    if (markedTexts.get(element) === text) return;
    markedTexts.set(element, text);
    const parts = text.split("`").map((part, place) => (place % 2 === 0 ? part : code(part)));
    element.replaceChildren(...parts);
}

/** A short text without spaces is not broken at its hyphens. */
function code(text: string): HTMLElement {
    return h("code", { className: text.includes(" ") ? "" : "word", textContent: text });
}

/** Sets text only if it differs, so that unchanged panels cause no layout. */
export function setText(element: Element, text: string): void {
    if (element.textContent !== text) element.textContent = text;
}
