/** The part of a page in the one stream of events that all pages of a browser share; a hidden page follows no job. */

import type { JobEvent } from "./api";
import { EventHub, type HubMessage, REPORT_MS, type PageMessage } from "./eventHub";

interface Follower {
  newest: number;
  onEvent: (event: JobEvent) => void;
  onEnd: () => void;
  onConnection: (open: boolean) => void;
}

const followers = new Map<string, Follower>();
let send: ((request: PageMessage) => void) | null = null;

/**
 * Follow the events of a job from the first one to its end. Each is delivered once and in order, whatever happens to
 * the connection.
 */
export function followEvents(
  job: string,
  onEvent: Follower["onEvent"],
  onEnd: () => void,
  onConnection: Follower["onConnection"],
): () => void {
  const follower = { newest: 0, onEvent, onEnd, onConnection };
  if (followers.delete(job)) report(); // so that the events are delivered again from the first one
  followers.set(job, follower);
  report();
  return () => {
    if (followers.get(job) !== follower) return;
    followers.delete(job);
    report();
  };
}

/** Close the stream of events for a while, so that all connections are free for the next request. */
export function freeConnections(): void {
  connect()({ clear: true });
}

function report(isVisible = !document.hidden): void {
  connect()({ follow: isVisible ? [...followers].map(([job, follower]) => [job, follower.newest]) : [] });
}

function connect(): (request: PageMessage) => void {
  if (send) return send;
  if (typeof SharedWorker === "undefined") {
    const hub = new EventHub();
    send = (request) => hub.handle(followers, request, deliver);
  } else {
    const { port } = new SharedWorker("/eventWorker.js", "dentine events");
    port.onmessage = (message: MessageEvent<HubMessage>) => deliver(message.data);
    send = (request) => port.postMessage(request);
  }
  document.addEventListener("visibilitychange", () => report());
  addEventListener("pagehide", () => report(false));
  addEventListener("pageshow", () => report());
  setInterval(() => {
    if (followers.size && !document.hidden) report();
  }, REPORT_MS);
  return send;
}

function deliver(message: HubMessage): void {
  if ("open" in message) {
    for (const follower of followers.values()) follower.onConnection(message.open);
    return;
  }
  const follower = followers.get(message.job);
  if (!follower) return;
  if ("state" in message) {
    followers.delete(message.job);
    follower.onEnd();
  } else if (message.id > follower.newest) {
    follower.newest = message.id;
    follower.onEvent(JSON.parse(message.text) as JobEvent);
  }
}
