/**
 * Limits the requests that all pages of a browser have under way at once. A browser opens six connections to a server
 * by HTTP/1.1: one is for the stream of events, one for an upload, three (the lanes) for all other requests, and so one
 * is left for a download. ALL OFF takes no lane and none of these connections; see allOff.
 */

const LANES = 3;
const UPLOAD = "dentine upload";

/**
 * Number of requests under way and those that wait, in a page without the browser's locks, which exist for secure
 * addresses alone.
 */
let running = 0;
const waiting: (() => void)[] = [];

/** Send a request once a lane is free. */
export async function inLane<T>(ask: () => Promise<T>): Promise<T> {
  if (!navigator.locks) return inOwnLane(ask);
  for (let lane = 0; lane < LANES; lane += 1) {
    const taken = await navigator.locks.request(name(lane), { ifAvailable: true }, async (lock) =>
      lock ? { answer: await ask() } : null,
    );
    if (taken) return taken.answer;
  }
  return navigator.locks.request(name(Math.floor(LANES * Math.random())), ask) as Promise<T>;
}

/** Send a part of an upload, which may take long, once no other part is on its way. */
export async function inUploadLane<T>(send: () => Promise<T>): Promise<T> {
  return navigator.locks ? (navigator.locks.request(UPLOAD, send) as Promise<T>) : send();
}

/** Show a picture, loaded in a lane. A picture that still waits for a lane is dropped when another one is asked for. */
export function showPicture(image: HTMLImageElement, url: string): void {
  image.dataset["wanted"] = url;
  void inLane(async () => {
    if (image.dataset["wanted"] !== url || image.getAttribute("src") === url) return;
    const isLoaded = new Promise<void>((done) => {
      for (const kind of ["load", "error"]) image.addEventListener(kind, () => done(), { once: true });
    });
    image.src = url;
    await isLoaded;
  });
}

function name(lane: number): string {
  return `dentine lane ${lane}`;
}

async function inOwnLane<T>(ask: () => Promise<T>): Promise<T> {
  if (running >= LANES) await new Promise<void>((go) => waiting.push(go));
  else running += 1;
  try {
    return await ask();
  } finally {
    const next = waiting.shift();
    if (next) next();
    else running -= 1;
  }
}
