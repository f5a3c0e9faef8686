/** Records a canvas as a video file. */

export interface VideoType {
    mimeType: string;
    extension: string;
}

/** MP4 with H.264 first, because video players and office programs support it most widely. */
const TYPES: readonly VideoType[] = [
    { mimeType: "video/mp4;codecs=avc1.640033", extension: "mp4" },
    { mimeType: "video/mp4", extension: "mp4" },
    { mimeType: "video/webm;codecs=vp9", extension: "webm" },
    { mimeType: "video/webm", extension: "webm" },
];

/** Bits per pixel and frame, and the largest bit rate. */
const BITS_PER_PIXEL = 0.15;
const FRAMES_PER_SECOND = 30;
const MAX_BITS_PER_SECOND = 25e6;
/** Milliseconds of video per chunk, so that the encoder does not buffer a long video. */
const PIECE_MS = 1000;

/** The first type that the browser can record; null if there is none. */
export function supportedType(isSupported: (mimeType: string) => boolean): VideoType | null {
    return TYPES.find(({ mimeType }) => isSupported(mimeType)) ?? null;
}

export function bitRate(width: number, height: number): number {
    return Math.min(MAX_BITS_PER_SECOND, Math.round(BITS_PER_PIXEL * FRAMES_PER_SECOND * width * height));
}

/** A video that is being recorded. */
export class VideoRecorder {
    private readonly pieces: Blob[] = [];
    private readonly recorder: MediaRecorder;
    readonly extension: string;
    /** The browser could not encode the video. */
    onError: (message: string) => void = () => {};

    /**
     * @param canvas Frames are recorded when they are drawn.
     * @throws Error with a sentence for the user if the browser cannot record.
     */
    constructor(readonly canvas: HTMLCanvasElement) {
        const hasRecorder = typeof MediaRecorder === "function" && "captureStream" in canvas;
        const type = hasRecorder ? supportedType((mimeType) => MediaRecorder.isTypeSupported(mimeType)) : null;
        if (!type)
            throw new Error("This browser cannot record videos. Current versions of Chrome, Firefox and Safari can.");
        this.extension = type.extension;
        this.recorder = new MediaRecorder(canvas.captureStream(FRAMES_PER_SECOND), {
            mimeType: type.mimeType,
            videoBitsPerSecond: bitRate(canvas.width, canvas.height),
        });
        this.recorder.ondataavailable = ({ data }) => this.pieces.push(data);
        this.recorder.onerror = (event) => this.onError(String((event as ErrorEvent).error ?? event.type));
        this.recorder.start(PIECE_MS);
    }

    /** Ends the recording. Returns the file. */
    stop(): Promise<Blob> {
        const { recorder } = this;
        const file = () => new Blob(this.pieces, { type: recorder.mimeType });
        if (recorder.state === "inactive") return Promise.resolve(file());
        return new Promise((resolve) => {
            recorder.onstop = () => {
                for (const track of recorder.stream.getTracks()) track.stop();
                resolve(file());
            };
            recorder.stop();
        });
    }
}
