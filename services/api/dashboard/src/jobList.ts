/** The jobs, newest first; more on demand. */

import { type Job, listJobs } from "./api";
import { element } from "./element";
import { when } from "./format";

export class JobList {
  private readonly items = element("ul");
  private readonly more = element("button", { type: "button" }, "Older jobs");
  private readonly empty = element("p", { class: "soft" }, "No job yet. Submit one: dentine submit JOB.toml");
  private older: Job[] = [];
  private next: number | null = null;
  private selected: string | null = null;
  private drawn = "";

  constructor(root: HTMLElement) {
    root.append(this.empty, this.items, this.more);
    this.more.addEventListener("click", () => void this.loadOlder());
  }

  select(id: string): void {
    this.selected = id;
    for (const link of this.items.querySelectorAll("a")) this.mark(link);
  }

  /** Load the newest jobs again; returns the newest one's id. */
  async refresh(): Promise<string | null> {
    const page = await listJobs(null);
    if (!this.older.length) this.next = page.next_before;
    this.draw(page.jobs);
    return page.jobs[0]?.id ?? null;
  }

  private async loadOlder(): Promise<void> {
    const page = await listJobs(this.next);
    this.older.push(...page.jobs);
    this.next = page.next_before;
    await this.refresh();
  }

  private draw(newest: Job[]): void {
    const last = newest.at(-1)?.number ?? 0;
    const jobs = [...newest, ...this.older.filter((job) => job.number < last)];
    const state = JSON.stringify(jobs.map((job) => [job.id, job.state]));
    this.empty.hidden = jobs.length > 0;
    this.more.hidden = this.next === null;
    if (state === this.drawn) return;
    this.drawn = state;
    const focused = document.activeElement?.getAttribute("href");
    this.items.replaceChildren(...jobs.map((job) => element("li", {}, this.link(job))));
    if (focused) this.items.querySelector<HTMLElement>(`a[href="${focused}"]`)?.focus();
  }

  private link(job: Job): HTMLAnchorElement {
    const badge = element("span", { class: "badge", "data-state": job.state }, job.state.toLowerCase());
    const link = element("a", { href: `#/${job.id}` }, element("strong", {}, `Job ${job.number}`), badge, element("span", { class: "soft" }, when(job.created_s)));
    this.mark(link);
    return link;
  }

  private mark(link: HTMLAnchorElement): void {
    if (link.hash === `#/${this.selected}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}
