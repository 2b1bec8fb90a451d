/** Three ways to a first job: the demonstration, a capture from this machine, a rig. */

import { getPreset, sentenceOf, submitJob, Unauthenticated } from "./api";
import { element } from "./element";
import { UploadCard } from "./uploadCard";

export const NEW = "#/new";
export const RIG = "#/rig";
export const SUBMIT = "#/submit";

export class NewJobView {
  private readonly run = element("button", { type: "button", class: "primary" }, "Run the demo");
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  private readonly upload = new UploadCard((capture) => this.uploaded(capture.id));
  private readonly ready = element("p");
  readonly root = element("article", { class: "ways" });
  private isShown = false;

  constructor() {
    this.refusal.hidden = true;
    this.ready.hidden = true;
    this.run.addEventListener("click", () => void this.demo());
    const options = element("a", { href: SUBMIT }, "choose from the captures that are here already");
    this.root.append(
      element("h2", {}, "New job"),
      element(
        "p",
        { class: "soft" },
        "A job turns a capture of a person's teeth into a measured, renderable asset, or images of a material in a " +
          "cell into its scattering properties. Three ways to begin:",
      ),
      element(
        "div",
        { class: "cards" },
        card(
          "Run the demo",
          "A simulated dome lights a virtual incisor, and the fit finds its optics again. Nothing is needed; " +
            "some minutes on two cores.",
          this.run,
          this.refusal,
        ),
        card(
          "Upload a capture",
          "A folder with capture.json, or raw.toml and photographs as cameras write them, with its meshes; " +
            "for a material in a cell, one with slab.json and its images. " +
            "Only what the server does not know yet is sent; an upload that breaks goes on when you choose the " +
            "folder again.",
          this.upload.root,
          this.ready,
          element("p", { class: "soft" }, "Or ", options, "."),
        ),
        card(
          "Connect a rig",
          "A dome with its lights and cameras captures for the job. What to set, and where; and whether the " +
            "dome answers.",
          element("a", { class: "button primary", href: RIG }, "Connect a rig"),
        ),
      ),
    );
  }

  start(): void {
    this.isShown = true;
  }

  /** Leave the view; an upload goes on while another view is shown. */
  stop(): void {
    this.isShown = false;
  }

  private uploaded(id: string): void {
    const address = `${SUBMIT}/${id}`;
    this.ready.hidden = false;
    this.ready.replaceChildren(element("a", { href: address }, "Choose its options and submit the job"));
    if (this.isShown) location.hash = address;
  }

  private async demo(): Promise<void> {
    this.run.disabled = true;
    this.refusal.hidden = true;
    try {
      const { options } = await getPreset("demo");
      const job = await submitJob({ ...options, name: "Demonstration" });
      location.hash = `#/${job.id}`;
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.refusal.hidden = false;
      this.refusal.textContent = sentenceOf(problem);
    } finally {
      this.run.disabled = false;
    }
  }
}

function card(title: string, text: string, ...content: HTMLElement[]): HTMLElement {
  return element("section", {}, element("h3", {}, title), element("p", {}, text), ...content);
}
