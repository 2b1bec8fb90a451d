/**
 * Comparison of render and photograph with a slider between them, and the residual beside. Earlier steps stay as a film
 * strip.
 */

import { artifactUrl, type JobEvent } from "./api";
import { element } from "./element";
import { significant } from "./format";
import { showPicture } from "./lanes";

interface Preview {
  camera: string;
  light: string;
  channel: string;
  step: number;
  heldOut: boolean;
  render: string;
  photo: string;
  residual: string;
  /** Labels of both ends of the residual's colour scale. */
  least: string;
  most: string;
}

const text = (value: unknown): string => (typeof value === "string" ? value : "");

export class Comparison {
  readonly root = element("div", { class: "comparison" });
  private readonly views = new Map<string, Map<number, Preview>>();
  private readonly choice = element("select", { id: "picture-choice" });
  private readonly step = element("input", { type: "range", id: "picture-step", min: "0", step: "1" });
  private readonly stepText = element("output", { for: "picture-step" });
  private readonly split = element("input", { type: "range", id: "picture-split", min: "0", max: "100", value: "50" });
  private readonly photo = element("img", { alt: "" });
  private readonly render = element("img", { alt: "", class: "over" });
  private readonly line = element("div", { class: "line" });
  private readonly residual = element("img", { alt: "" });
  private readonly least = element("span");
  private readonly most = element("span");
  private followsLatest = true;

  constructor(private readonly job: string) {
    this.root.append(element("p", { class: "soft" }, "No picture yet."));
    this.choice.addEventListener("change", () => this.show(true));
    this.step.addEventListener("input", () => {
      this.followsLatest = this.step.value === this.step.max;
      this.show(false);
    });
    this.split.addEventListener("input", () => this.place());
  }

  add(event: JobEvent): void {
    const {
      camera,
      light,
      channel,
      step,
      render,
      photo,
      residual,
      held_out: heldOut,
      residual_of_white: ofWhite,
      residual_limit: limit,
    } = event.data;
    const share =
      typeof ofWhite === "number"
        ? `${100 * ofWhite} % of white`
        : typeof limit === "number"
          ? `${significant(limit)} of radiance`
          : "";
    const preview: Preview = {
      camera: text(camera),
      light: text(light),
      channel: text(channel),
      step: typeof step === "number" ? step : event.id,
      heldOut: heldOut === true,
      render: text(render),
      photo: text(photo),
      residual: text(residual),
      least: share && `−${share}`,
      most: share && `+${share}`,
    };
    const key = [preview.channel, preview.camera, preview.light].filter(Boolean).join(" · ");
    if (!this.views.size) this.build();
    const steps = this.views.get(key) ?? new Map<number, Preview>();
    if (!this.views.has(key))
      this.choice.append(element("option", { value: key }, preview.heldOut ? `${key} (held out)` : key));
    this.views.set(key, steps.set(preview.step, preview));
    if (this.choice.value === key) this.show(this.followsLatest);
  }

  private build(): void {
    const controls = element(
      "div",
      { class: "controls" },
      element("label", { for: "picture-choice" }, "Picture"),
      this.choice,
      element("label", { for: "picture-step" }, "Step"),
      this.step,
      this.stepText,
      element("label", { for: "picture-split" }, "Render | photo"),
      this.split,
    );
    const stack = element("div", { class: "stack" }, this.photo, this.render, this.line);
    const scale = element(
      "p",
      { class: "scale" },
      this.least,
      element("i", { role: "img", "aria-label": "Colours of the residual, from blue over white to orange" }),
      this.most,
    );
    const pictures = element(
      "div",
      { class: "pictures" },
      element("figure", {}, stack, element("figcaption", {}, "left of the line: render; right: photograph")),
      element(
        "figure",
        {},
        this.residual,
        scale,
        element(
          "figcaption",
          {},
          "residual: render less photograph; blue where the render is darker, orange where it is brighter",
        ),
      ),
    );
    this.root.replaceChildren(controls, pictures);
    this.place();
  }

  private show(latest: boolean): void {
    const steps = [...(this.views.get(this.choice.value)?.values() ?? [])].sort((a, b) => a.step - b.step);
    this.step.max = String(Math.max(steps.length - 1, 0));
    if (latest) this.step.value = this.step.max;
    const shown = steps[Number(this.step.value)];
    if (!shown) return;
    const name = `camera ${shown.camera}, light ${shown.light}, step ${shown.step}`;
    this.stepText.textContent = String(shown.step);
    this.least.textContent = shown.least;
    this.most.textContent = shown.most;
    for (const [image, path, kind] of [
      [this.render, shown.render, "Render"],
      [this.photo, shown.photo, "Photograph"],
      [this.residual, shown.residual, "Residual"],
    ] as const) {
      image.alt = `${kind}: ${name}`;
      showPicture(image, artifactUrl(this.job, path));
    }
  }

  private place(): void {
    const share = `${this.split.value}%`;
    this.render.style.setProperty("clip-path", `inset(0 calc(100% - ${share}) 0 0)`);
    this.line.style.setProperty("left", share);
  }
}
