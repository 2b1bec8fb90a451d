/** The fit of a slab: the wavelengths as they are finished, and the resulting phase functions. */

import { type Artifact, artifactUrl, type JobEvent } from "./api";
import { element } from "./element";
import { showPicture } from "./lanes";

/** Names of a slab's quantities, as in its report. */
const QUANTITIES: Record<string, string> = {
  sigma_t: "extinction σt",
  sigma_s: "scattering σs",
  sigma_a: "absorption σa",
  sigma_s_reduced: "reduced scattering σs′",
  g: "mean cosine g",
  index: "index of refraction",
  volume_fraction: "volume of all spheres",
  mean_radius: "mean radius, by volume",
};

/** Return the name of a slab's quantity for people. */
export function quantityOf(parameter: string): string {
  return QUANTITIES[parameter] ?? parameter;
}

const PICTURE = /^phase_(.+)\.svg$/;

export class SlabView {
  readonly progress = element(
    "div",
    { "aria-live": "polite" },
    element("p", { class: "soft" }, "No wavelength is done yet; each is fitted as a whole."),
  );
  readonly phases = element(
    "div",
    { class: "phases" },
    element("p", { class: "soft" }, "No phase function yet; it comes when all wavelengths are done."),
  );
  /** Message of each wavelength that is finished, by the wavelength in nm. */
  private readonly messages = new Map<number, string>();
  private shown = "";

  constructor(private readonly job: string) {}

  take(event: JobEvent): void {
    const { wavelength_nm: wavelength, wavelengths: all } = event.data;
    if (typeof wavelength !== "number" || typeof all !== "number") return;
    this.messages.set(wavelength, event.message);
    const rows = [...this.messages]
      .sort(([one], [other]) => one - other)
      .map(([, message]) => element("li", {}, message));
    this.progress.replaceChildren(
      element("p", { class: "soft" }, `${this.messages.size} of ${all} wavelengths done.`),
      element("ul", { class: "wavelengths" }, ...rows),
    );
  }

  /** Show the pictures of the report, once they exist. */
  list(files: Artifact[]): void {
    const names = files
      .map((file) => PICTURE.exec(file.path)?.[1])
      .filter((name): name is string => name !== undefined);
    if (!names.length || this.shown === names.join()) return;
    this.shown = names.join();
    names.sort((one, other) => Number(one) - Number(other));
    this.phases.replaceChildren(...names.map((name) => this.figure(name)));
  }

  private figure(name: string): HTMLElement {
    const alt =
      `Phase function at ${name} nm: per sr, against the scattering angle from 0 to 180 degrees, ` +
      "with its standard error";
    const picture = element("img", { alt, width: "640", height: "300" });
    showPicture(picture, artifactUrl(this.job, `phase_${name}.svg`));
    const says =
      `${name} nm. The band is ± one standard error; ` +
      "in grey ranges the images do not tell, and the values are the prior's.";
    return element("figure", {}, picture, element("figcaption", {}, says));
  }
}
