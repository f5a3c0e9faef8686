/** Files and folders that the user drops onto the page. */

import type { UploadedFile } from "../source/server";

/** Calls `open` with the files of each drop. A dropped folder gives all files in it. */
export function listenToDrops(open: (files: UploadedFile[]) => void): void {
    const highlight = (isOver: boolean) => document.body.classList.toggle("dropping", isOver);
    window.addEventListener("dragover", (event) => {
        event.preventDefault();
        highlight(event.dataTransfer?.types.includes("Files") ?? false);
    });
    window.addEventListener("dragleave", (event) => {
        // Between two elements of the page, the event has the element that the pointer enters.
        if (event.relatedTarget === null) highlight(false);
    });
    window.addEventListener("drop", (event) => {
        event.preventDefault();
        highlight(false);
        // The items exist during the event only, so their entries are taken at once.
        const items = [...(event.dataTransfer?.items ?? [])].filter(({ kind }) => kind === "file");
        const dropped = items.map((item) => ({ entry: item.webkitGetAsEntry?.() ?? null, file: item.getAsFile() }));
        void readDropped(dropped).then((files) => files.length > 0 && open(files));
    });
}

interface DroppedItem {
    entry: FileSystemEntry | null;
    file: File | null;
}

/** All files. The paths of a single folder are relative to it. */
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
        // Each call returns some of the entries, and the last one none.
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
