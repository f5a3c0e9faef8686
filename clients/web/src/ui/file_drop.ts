/** Files and folders that the user drops onto the page. */

import type { UploadedFile } from "../source/server";

/** Calls `open` with the files of each drop. Of a dropped folder, these are all files that are not hidden. */
export function listenToDrops(open: (files: UploadedFile[]) => void): void {
    const highlight = (isOver: boolean) => document.body.classList.toggle("dropping", isOver);
    window.addEventListener("dragover", (event) => {
        event.preventDefault();
        highlight(event.dataTransfer?.types.includes("Files") ?? false);
    });
    window.addEventListener("dragleave", (event) => {
        // `relatedTarget` is null only if the pointer leaves the page, not if it enters another element.
        if (event.relatedTarget === null) highlight(false);
    });
    window.addEventListener("drop", (event) => {
        event.preventDefault();
        highlight(false);
        // The items are valid only during the event, so their entries are read here.
        const items = [...(event.dataTransfer?.items ?? [])].filter(({ kind }) => kind === "file");
        const dropped = items.map((item) => ({ entry: item.webkitGetAsEntry?.() ?? null, file: item.getAsFile() }));
        void readDropped(dropped).then((files) => files.length > 0 && open(files));
    });
}

interface DroppedItem {
    entry: FileSystemEntry | null;
    file: File | null;
}

/** Reads all dropped files. If a single folder was dropped, the paths are relative to it. */
async function readDropped(items: DroppedItem[]): Promise<UploadedFile[]> {
    const files: UploadedFile[] = [];
    for (const { entry, file } of items) {
        if (entry?.isDirectory) {
            const prefix = items.length > 1 ? `${entry.name}/` : "";
            files.push(...(await readFolder(entry as FileSystemDirectoryEntry, prefix)));
        } else if (file) files.push({ path: file.name, file });
    }
    return files;
}

async function readFolder(folder: FileSystemDirectoryEntry, prefix: string): Promise<UploadedFile[]> {
    const reader = folder.createReader();
    const files: UploadedFile[] = [];
    for (;;) {
        // Each call returns some of the entries, and the last call returns none.
        const entries = await new Promise<FileSystemEntry[]>((done, fail) => reader.readEntries(done, fail));
        if (entries.length === 0) return files;
        for (const entry of entries) {
            const path = prefix + entry.name;
            if (entry.name.startsWith(".")) continue;
            if (entry.isDirectory) files.push(...(await readFolder(entry as FileSystemDirectoryEntry, `${path}/`)));
            else {
                const file = await new Promise<File>((done, fail) => (entry as FileSystemFileEntry).file(done, fail));
                files.push({ path, file });
            }
        }
    }
}
