/** The part of a page in the one stream of events that all pages of a browser share; a hidden page follows no job. */

import type { JobEvent } from "./api";
import { EventHub, type News, TELL_MS, type Wish } from "./eventHub";

interface Follower {
  newest: number;
  onEvent: (event: JobEvent) => void;
  onEnd: () => void;
  onConnection: (open: boolean) => void;
}

const followers = new Map<string, Follower>();
let send: ((wish: Wish) => void) | null = null;

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
  if (followers.delete(job)) tell(); // so that the events are delivered again from the first one
  followers.set(job, follower);
  tell();
  return () => {
    if (followers.get(job) !== follower) return;
    followers.delete(job);
    tell();
  };
}

/** Close the stream of events for a while, so that all connections are free for the next request. */
export function clearTheWay(): void {
  connect()({ clear: true });
}

function tell(isHere = !document.hidden): void {
  connect()({ follow: isHere ? [...followers].map(([job, follower]) => [job, follower.newest]) : [] });
}

function connect(): (wish: Wish) => void {
  if (send) return send;
  if (typeof SharedWorker === "undefined") {
    const hub = new EventHub();
    send = (wish) => hub.take(followers, wish, take);
  } else {
    const { port } = new SharedWorker("/eventWorker.js", "dentine events");
    port.onmessage = (message: MessageEvent<News>) => take(message.data);
    send = (wish) => port.postMessage(wish);
  }
  document.addEventListener("visibilitychange", () => tell());
  addEventListener("pagehide", () => tell(false));
  addEventListener("pageshow", () => tell());
  setInterval(() => {
    if (followers.size && !document.hidden) tell();
  }, TELL_MS);
  return send;
}

function take(news: News): void {
  if ("open" in news) {
    for (const follower of followers.values()) follower.onConnection(news.open);
    return;
  }
  const follower = followers.get(news.job);
  if (!follower) return;
  if ("state" in news) {
    followers.delete(news.job);
    follower.onEnd();
  } else if (news.id > follower.newest) {
    follower.newest = news.id;
    follower.onEvent(JSON.parse(news.text) as JobEvent);
  }
}
