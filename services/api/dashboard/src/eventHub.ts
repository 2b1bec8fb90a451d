/**
 * One stream of events for all pages of a browser. A browser opens no more than six connections to a server, so that a
 * stream for each page would leave none for ALL OFF. Runs in a shared worker, or in the page itself where there are
 * none.
 */

const REOPEN_MS = 3000;
/**
 * Time in ms before the stream is opened, so that pages that open or leave a job at about the same time share one
 * opening.
 */
const GATHER_MS = 30;
/**
 * Time in ms between two reports of a page on the jobs that it follows. A page that was silent for four times as long
 * was closed without notice.
 */
export const REPORT_MS = 10_000;
const EXPIRY_MS = 4 * REPORT_MS;
/** Time in ms for which the stream stays closed for ALL OFF, so that a connection is free. */
const CLEAR_MS = 2000;

/**
 * Message of a page: the jobs that it follows, each with the id of the last event that it knows, or that all
 * connections are needed.
 */
export type PageMessage = { follow: [job: string, after: number][] } | { clear: true };
/** Message to a page. `text` is an event as JSON; `state` is null for a job that does not exist. */
export type HubMessage =
  { job: string; id: number; text: string } | { job: string; state: string | null } | { open: boolean };

interface Page {
  positions: Map<string, number>;
  heardMs: number;
  notify: (message: HubMessage) => void;
}

export class EventHub {
  private readonly pages = new Map<unknown, Page>();
  private source: EventSource | null = null;
  /** The jobs of the stream that is open, or was open last. */
  private streamed = "";
  /** By job, the id of the last event that the stream has delivered, or after which it began. */
  private delivered = new Map<string, number>();
  private timer = 0;

  constructor() {
    setInterval(() => this.dropSilentPages(), REPORT_MS);
  }

  /** Handle the message of a page. */
  handle(page: unknown, request: PageMessage, notify: (message: HubMessage) => void): void {
    if ("clear" in request) {
      this.clear();
      return;
    }
    if (!request.follow.length) {
      this.pages.delete(page);
    } else {
      const known = this.pages.get(page)?.positions;
      const positions = new Map(request.follow.map(([job, after]) => [job, Math.max(after, known?.get(job) ?? 0)]));
      this.pages.set(page, { positions, heardMs: Date.now(), notify });
      if (this.source?.readyState === EventSource.OPEN) notify({ open: true });
    }
    this.openSoon(GATHER_MS);
  }

  /** By job, the smallest id after which some page lacks events. */
  private positions(): Map<string, number> {
    const positions = new Map<string, number>();
    for (const page of this.pages.values()) {
      for (const [job, after] of page.positions) positions.set(job, Math.min(after, positions.get(job) ?? after));
    }
    return positions;
  }

  private openSoon(afterMs: number): void {
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.open(), afterMs) as unknown as number;
  }

  private close(): void {
    this.source?.close();
    this.source = null;
    this.streamed = "";
  }

  /**
   * Open a stream of the jobs that are followed, unless it is open already and no page lacks events that it has
   * delivered.
   */
  private open(): void {
    const positions = this.positions();
    const jobs = [...positions.keys()].sort().join();
    if (this.source && jobs === this.streamed && !this.isBehind()) return;
    this.close();
    if (!positions.size) return;
    this.streamed = jobs;
    this.delivered = new Map(positions);
    const query = [...positions].map(([job, after]) => `job=${job}:${after}`).join("&");
    const source = new EventSource(`/v1/events?${query}`);
    this.source = source;
    source.onopen = () => this.notifyAll({ open: true });
    source.onerror = () => {
      if (this.source !== source) return;
      this.close();
      this.notifyAll({ open: false });
      this.openSoon(REOPEN_MS);
    };
    source.onmessage = (message) => {
      const { id, job } = JSON.parse(message.data) as { id: number; job: string };
      this.delivered.set(job, id);
      for (const page of this.pages.values()) {
        const after = page.positions.get(job);
        if (after === undefined || id <= after) continue;
        page.positions.set(job, id);
        page.notify({ job, id, text: message.data });
      }
    };
    source.addEventListener("end", (message) => {
      const { job, state } = JSON.parse((message as MessageEvent<string>).data) as {
        job: string;
        state: string | null;
      };
      this.streamed = this.streamed
        .split(",")
        .filter((one) => one !== job)
        .join();
      if (!this.streamed) this.close();
      for (const page of this.pages.values()) if (page.positions.delete(job)) page.notify({ job, state });
    });
  }

  private isBehind(): boolean {
    // A page that opened later, or was shown again, needs events that were delivered already.
    return [...this.positions()].some(([job, after]) => after < (this.delivered.get(job) ?? 0));
  }

  private notifyAll(message: HubMessage): void {
    for (const page of this.pages.values()) page.notify(message);
  }

  private clear(): void {
    this.close();
    this.openSoon(CLEAR_MS);
  }

  private dropSilentPages(): void {
    for (const [key, page] of this.pages) if (page.heardMs < Date.now() - EXPIRY_MS) this.pages.delete(key);
    if (this.source) this.openSoon(0);
  }
}
