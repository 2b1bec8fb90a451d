/** The list of jobs, newest first; older ones are loaded on demand. */

import { type Job, listJobs, sentenceOf, Unauthenticated } from "./api";
import { element } from "./element";
import { badgeOf, when } from "./format";

const PAGE = 50;
/** Largest number of jobs that the server lists at once; older ones are not refreshed. */
const MAX_LISTED = 500;

export class JobList {
  private readonly items = element("ul");
  private readonly more = element("button", { type: "button" }, "Older jobs");
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  private readonly empty = element("p", { class: "soft" }, "No job yet.");
  /** The jobs that are shown, newest first and without a gap. */
  private jobs: Job[] = [];
  private showsOlder = false;
  private isLoading = false;
  private selected: string | null = null;
  private drawn = "";

  constructor(root: HTMLElement) {
    this.refusal.hidden = true;
    this.empty.hidden = true;
    this.more.hidden = true;
    root.append(this.empty, this.items, this.refusal, this.more);
    this.more.addEventListener("click", () => void this.loadOlder());
  }

  select(id: string): void {
    this.selected = id;
    for (const link of this.items.querySelectorAll("a")) this.mark(link);
  }

  /** Load the jobs that are shown again, as older jobs change too; returns the id of the newest one. */
  async refresh(): Promise<string | null> {
    const { jobs, next_before: last } = await listJobs(
      this.showsOlder ? Math.min(Math.max(this.jobs.length, PAGE), MAX_LISTED) : PAGE,
    );
    const joint = this.jobs.findIndex((job) => job.number === last);
    const below = this.showsOlder && joint >= 0 ? this.jobs.slice(joint + 1) : [];
    if (!below.length) this.more.hidden = last === null;
    this.draw([...jobs, ...below]);
    return jobs[0]?.id ?? null;
  }

  private async loadOlder(): Promise<void> {
    if (this.isLoading) return;
    const lowest = this.jobs.at(-1)?.number ?? 0;
    this.showsOlder = true;
    this.isLoading = true; // not the button's `disabled`, which would take its focus
    this.refusal.hidden = true;
    try {
      const page = await listJobs(PAGE, lowest);
      this.more.hidden = page.next_before === null;
      this.draw([...this.jobs.filter((job) => job.number >= lowest), ...page.jobs]);
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.refusal.hidden = false;
      this.refusal.textContent = sentenceOf(problem);
    } finally {
      this.isLoading = false;
    }
  }

  private draw(jobs: Job[]): void {
    this.jobs = jobs;
    const state = JSON.stringify(jobs.map((job) => [job.id, job.state, job.name, job.verdict?.converged]));
    this.empty.hidden = jobs.length > 0;
    if (state === this.drawn) return;
    this.drawn = state;
    const focused = this.items.contains(document.activeElement) ? document.activeElement?.getAttribute("href") : null;
    this.items.replaceChildren(...jobs.map((job) => element("li", {}, this.link(job))));
    if (focused) this.items.querySelector<HTMLElement>(`a[href="${focused}"]`)?.focus();
  }

  private link(job: Job): HTMLAnchorElement {
    const { text, state } = badgeOf(job);
    const badge = element("span", { class: "badge", "data-state": state }, text);
    const label = job.name ? [element("span", { class: "name" }, job.name)] : [];
    const link = element(
      "a",
      { href: `#/${job.id}` },
      element("strong", {}, `Job ${job.number}`),
      badge,
      ...label,
      element("span", { class: "soft" }, when(job.created_s)),
    );
    this.mark(link);
    return link;
  }

  private mark(link: HTMLAnchorElement): void {
    if (link.hash === `#/${this.selected}`) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
}
