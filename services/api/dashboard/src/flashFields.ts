/** The part of the form for a job with a rig in which a person acknowledges more than three flashes a second. */

import { element } from "./element";

const FREE_PER_S = 3;

export class FlashFields {
  private readonly perS = element("input", { id: "flashes-per-s", type: "number", min: "0", step: "any" });
  private readonly covered = element("input", { id: "flashes-eye-cover", type: "checkbox" });
  private readonly asked = element("input", { id: "flashes-epilepsy-asked", type: "checkbox" });
  private readonly by = element("input", { id: "flashes-by", type: "text", maxlength: "80", autocomplete: "off" });
  readonly root = element(
    "details",
    {},
    element("summary", {}, "Flashes"),
    element(
      "p",
      {},
      "A dome that lights one LED after another flashes. Three to 65 flashes a second can trigger epileptic " +
        "seizures, so a capture flashes at most three times in any second, and 54 lights with preflight take about " +
        "40 s. Fill this in only for a faster capture: the subject's eyes are covered, and the subject and whoever " +
        "else sees the dome were asked about epilepsy. It holds for 24 hours and for one attempt, and is kept with " +
        "the capture and in the audit log. A simulated dome needs none of it.",
    ),
    element(
      "div",
      { class: "options" },
      labelled("Flashes a second", this.perS),
      labelled("The eyes are covered", this.covered),
      labelled("Epilepsy was asked about", this.asked),
      labelled("Name of who covered and asked", this.by),
    ),
  );

  /** Return the acknowledgement, given now; undefined where no more than three flashes a second are wanted. */
  value(): object | undefined {
    const perS = Number(this.perS.value);
    if (!this.perS.value || perS === FREE_PER_S) return undefined;
    return {
      per_s: perS,
      eye_cover: this.covered.checked,
      epilepsy_asked: this.asked.checked,
      by: this.by.value.trim(),
      at: new Date().toISOString(),
    };
  }
}

function labelled(text: string, input: HTMLInputElement): HTMLElement {
  const kind = input.type === "checkbox" ? "option check" : "option";
  return element("div", { class: kind }, element("label", { for: input.id }, text), input);
}
