/**
 * Uploads a folder: hashes its files, sends the server their list, and sends by tus the bytes that the server lacks. No
 * state is kept here, because the server knows what it has: the same folder, chosen again in this page or another one,
 * goes on where an upload was interrupted.
 */

import { sha256 } from "@noble/hashes/sha2.js";

import { ask, Refusal, Unauthenticated } from "./api";
import type { FolderFile } from "./folder";
import { inUploadLane } from "./lanes";

const BLOCK_BYTES = 4 * 2 ** 20;
const MIN_WAIT_MS = 500;
const MAX_WAIT_MS = 8000;
/** Time in ms for which one step is tried again while it fails. */
const PATIENCE_MS = 5 * 60_000;
const TUS = { "Tus-Resumable": "1.0.0" };

export interface UploadProgress {
  phase: "hashing" | "sending";
  path: string;
  doneBytes: number;
  totalBytes: number;
}

export interface UploadedCapture {
  id: string;
  path: string;
}

interface KnownFile {
  path: string;
  bytes: number;
  received_bytes: number;
  is_known: boolean;
  upload: string;
}

interface OpenCapture extends UploadedCapture {
  files: KnownFile[];
}

export class FolderUpload {
  private readonly totalBytes: number;
  private doneBytes = 0;

  constructor(
    private readonly files: FolderFile[],
    private readonly onProgress: (progress: UploadProgress) => void,
  ) {
    this.totalBytes = files.reduce((sum, { file }) => sum + file.size, 0);
  }

  async run(): Promise<UploadedCapture> {
    const empty = this.files.find(({ file }) => file.size === 0);
    if (empty) throw new Error(`File ${empty.path} is empty; leave it out or export it again.`);
    const files: { path: string; bytes: number; sha256: string }[] = [];
    for (const one of this.files) files.push({ path: one.path, bytes: one.file.size, sha256: await this.hash(one) });
    const capture = await patiently(() => ask<OpenCapture>("/captures", "POST", {}, { files }));
    this.doneBytes = capture.files.reduce((sum, file) => sum + file.received_bytes, 0);
    const here = new Map(this.files.map(({ path, file }) => [path, file]));
    for (const file of capture.files) {
      const source = here.get(file.path);
      if (source && !file.is_known) await this.send(source, capture.id, file);
    }
    return patiently(() => ask<UploadedCapture>(`/captures/${capture.id}/commit`, "POST"));
  }

  private async hash({ path, file }: FolderFile): Promise<string> {
    const hash = sha256.create();
    for (let start = 0; start < file.size; start += BLOCK_BYTES) {
      const block = await read(file, path, start);
      hash.update(block);
      this.doneBytes += block.length;
      this.report("hashing", path);
    }
    return [...hash.digest()].map((byte) => byte.toString(16).padStart(2, "0")).join("");
  }

  private async send(source: File, capture: string, file: KnownFile): Promise<void> {
    const metadata = {
      "Upload-Length": `${file.bytes}`,
      "Upload-Metadata": `capture ${base64(utf8(capture))},path ${base64(utf8(file.path))}`,
    };
    let offset = await patiently(() => offsetAfter("POST", "/uploads", metadata));
    const before = this.doneBytes - file.received_bytes;
    this.doneBytes = before + offset;
    this.report("sending", file.path);
    let isSure = true;
    while (offset < file.bytes) {
      offset = await patiently(async () => {
        const start = isSure ? offset : await offsetAfter("HEAD", file.upload.slice("/v1".length), {});
        isSure = false; // until the server has answered
        const next = start < file.bytes ? await append(file, start, await read(source, file.path, start)) : start;
        isSure = true;
        return next;
      });
      this.doneBytes = before + offset;
      this.report("sending", file.path);
    }
  }

  private report(phase: UploadProgress["phase"], path: string): void {
    this.onProgress({ phase, path, doneBytes: this.doneBytes, totalBytes: this.totalBytes });
  }
}

async function append(file: KnownFile, start: number, block: Uint8Array<ArrayBuffer>): Promise<number> {
  const checksum = `sha256 ${base64(sha256(block))}`;
  const headers = {
    "Upload-Offset": `${start}`,
    "Content-Type": "application/offset+octet-stream",
    "Upload-Checksum": checksum,
  };
  return offsetAfter("PATCH", file.upload.slice("/v1".length), headers, block);
}

/** Send a tus request; resolves to the offset of the next byte. */
async function offsetAfter(
  method: string,
  path: string,
  headers: Record<string, string>,
  body?: BodyInit,
): Promise<number> {
  const answer = await inUploadLane(() =>
    fetch(`/v1${path}`, { method, headers: { ...TUS, ...headers }, ...(body === undefined ? {} : { body }) }),
  );
  if (!answer.ok) {
    const problem = await answer.json().catch(() => null);
    // The server has another number of bytes than this page assumed, so 423 makes the next try ask for it.
    const isElsewhere = problem?.code === "upload-offset";
    throw new (answer.status === 401 ? Unauthenticated : Refusal)(
      problem?.detail ?? `The server answered ${answer.status}.`,
      isElsewhere ? 423 : answer.status,
    );
  }
  return Number(answer.headers.get("Upload-Offset"));
}

/** Try a step again at growing intervals, while it fails for a reason that may pass. */
async function patiently<T>(step: () => Promise<T>): Promise<T> {
  const until = Date.now() + PATIENCE_MS;
  for (let wait = MIN_WAIT_MS; ; wait = Math.min(2 * wait, MAX_WAIT_MS)) {
    try {
      return await step();
    } catch (problem) {
      if (!isPassing(problem) || Date.now() + wait > until) throw problem;
    }
    await new Promise((done) => setTimeout(done, wait));
  }
}

function isPassing(problem: unknown): boolean {
  if (problem instanceof Refusal)
    return [408, 423, 429].includes(problem.status) || (problem.status >= 500 && problem.status !== 507);
  return problem instanceof TypeError;
}

async function read(file: File, path: string, start: number): Promise<Uint8Array<ArrayBuffer>> {
  try {
    return new Uint8Array(await file.slice(start, start + BLOCK_BYTES).arrayBuffer());
  } catch {
    throw new Error(`File ${path} cannot be read any more; it was changed or moved. Choose the folder again.`);
  }
}

function utf8(text: string): Uint8Array {
  return new TextEncoder().encode(text);
}

function base64(bytes: Uint8Array): string {
  return btoa(String.fromCharCode(...bytes));
}
