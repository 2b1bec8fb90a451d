/** The form for a job, built from the server's own schema of options: source, preset, name, then groups of options. */

import {
  type Capture,
  getCapture,
  getOptions,
  listCalibrations,
  listCaptures,
  listPresets,
  type NamedCalibration,
  type OptionsSchema,
  type Preset,
  sentenceOf,
  submitJob,
  Unauthenticated,
} from "./api";
import { element } from "./element";
import { FlashFields } from "./flashFields";
import { bytes, when } from "./format";
import { OptionField } from "./optionField";

const SOURCES = new Set(["capture", "rig"]);
/**
 * Titles of groups and the options in them. Options of the schema that are in no group come last, so that none is
 * missing.
 */
const GROUPS: [string, string[]][] = [
  [
    "What is fitted",
    [
      "kind",
      "fdi",
      "surroundings",
      "boundary",
      "ior",
      "roughness",
      "multiple_scattering",
      "dentin",
      "stains",
      "lobes",
    ],
  ],
  [
    "Images",
    [
      "channels",
      "held_out_lights",
      "left_out_lights",
      "calibration",
      "accept_calibration",
      "instrument",
      "highlights",
      "shadows",
      "motion",
      "pixel_step",
      "sensor_noise_relative",
      "sensor_noise_floor",
    ],
  ],
  [
    "Accuracy and time",
    [
      "samples_per_pixel",
      "max_samples_per_pixel",
      "max_steps",
      "image_tolerance",
      "search_candidates",
      "advise",
      "seed",
      "priority",
      "workers",
      "memory_gib",
      "device",
    ],
  ],
  ["Slab", ["dictionary", "particle_index", "particle_absorption", "effort"]],
  ["Solver", ["solver", "loss", "adam_steps", "adam_rate", "prior", "held"]],
];
const RIG_FIRST = ["dome", "mouth", "level", "exposure_s"];
/** Option of a rig that has fields of its own. */
const FLASHES = "flashes";
const LONGEST_NAME = "80";
const DEFAULT_KIND = "tooth";
const SLAB_KIND = "slab";
/** File that makes a capture one of a slab. */
const SLAB_DESCRIPTION = "slab.json";
/** Name of the demonstration as a source, and of the preset with the options that its capture needs. */
const DEMO = "demo";

export class SubmitView {
  readonly root = element("form", { class: "submit", novalidate: "" });
  private readonly source = element("select", { id: "source" });
  private readonly capture = element("select", { id: "capture" });
  private readonly preset = element("select", { id: "preset" });
  private readonly summary = element("p", { class: "soft help" });
  private readonly name = element("input", { id: "name", type: "text", maxlength: LONGEST_NAME, autocomplete: "off" });
  private readonly go = element("button", { class: "primary" }, "Submit the job");
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  private readonly options = element("div");
  private readonly rigOptions = element("section", {}, element("h3", {}, "Rig"));
  private fields: OptionField[] = [];
  private rigFields: OptionField[] = [];
  private readonly flashes = new FlashFields();
  private foreign: OptionsSchema["foreign_options"] = {};
  private presets: Preset[] = [];
  private demo: Preset["options"] = {};
  private filledForDemo = false;
  /** Whether the selected capture is one of a slab; false until its files are known. */
  private isSlabSelected = false;

  /** `chosen` is the id of a capture, or "rig"; if it is empty, the newest capture is selected. */
  constructor(private readonly chosen: string) {
    this.refusal.hidden = true;
    this.source.addEventListener("change", () => {
      this.showSource();
      if (this.isDemo !== this.filledForDemo) this.takePreset();
      void this.recogniseCapture();
    });
    this.capture.addEventListener("change", () => void this.recogniseCapture());
    this.preset.addEventListener("change", () => this.takePreset());
    this.root.addEventListener("submit", (event) => {
      event.preventDefault();
      void this.submit();
    });
  }

  async start(): Promise<void> {
    const [schema, presets, captures, calibrations] = await Promise.all([
      getOptions(),
      listPresets(),
      listCaptures(),
      listCalibrations(),
    ]);
    this.fill(
      schema,
      presets,
      captures.captures.filter((one) => one.state === "committed"),
    );
    this.offer(calibrations);
    await this.recogniseCapture();
  }

  stop(): void {}

  private fill(schema: OptionsSchema, presets: Preset[], captures: Capture[]): void {
    this.presets = presets.filter((one) => one.name !== DEMO);
    this.demo = presets.find((one) => one.name === DEMO)?.options ?? {};
    const option = (value: string, text: string) => element("option", { value }, text);
    this.source.append(
      option("capture", "An uploaded capture"),
      option("rig", "A rig"),
      option(DEMO, "The demonstration's virtual incisor"),
    );
    this.capture.append(
      ...captures.map((one) => option(one.id, `${one.subject ?? one.id}, ${bytes(one.bytes)}, ${when(one.created_s)}`)),
    );
    this.preset.append(...this.presets.map((one) => option(one.name, one.name)));
    this.preset.value = "standard";
    this.source.value = this.chosen === "rig" ? "rig" : captures.length || this.chosen ? "capture" : DEMO;
    if (captures.some((one) => one.id === this.chosen)) this.capture.value = this.chosen;

    const rig = schema.$defs["RigSpec"]?.properties ?? {};
    const inOrder = [
      ...RIG_FIRST,
      ...Object.keys(rig).filter(
        (name) => ![...RIG_FIRST, FLASHES].includes(name) && rig[name]?.["$ref"] === undefined,
      ),
    ];
    this.rigFields = inOrder.map((name) => new OptionField(`rig.${name}`, rig[name] ?? {}, name === "mouth"));
    this.rigOptions.append(element("div", { class: "options" }, ...this.rigFields.map((field) => field.root)), this.flashes.root);

    const grouped = new Set(GROUPS.flatMap(([, names]) => names));
    const others = Object.keys(schema.properties).filter((name) => !grouped.has(name) && !SOURCES.has(name));
    for (const [title, names] of [...GROUPS, ["Other options", others] as [string, string[]]]) {
      const fields = names
        .filter((name) => name in schema.properties)
        .map((name) => new OptionField(name, schema.properties[name] ?? {}));
      if (!fields.length) continue;
      this.fields.push(...fields);
      const group = element(
        "details",
        {},
        element("summary", {}, title),
        element("div", { class: "options" }, ...fields.map((field) => field.root)),
      );
      if (title === GROUPS[0]?.[0]) group.open = true;
      this.options.append(group);
    }
    this.foreign = schema.foreign_options;
    this.fields.find((one) => one.name === "kind")?.onChange(() => this.showKind());
    this.arrange(captures.length > 0);
  }

  /** Choose the kind of job that the selected capture is for, where its files tell. */
  private async recogniseCapture(): Promise<void> {
    const id = this.source.value === "capture" ? this.capture.value : "";
    const isSlab = id !== "" && (await isOfSlab(id));
    // Another capture may have been selected meanwhile
    if ((id && id !== this.capture.value) || isSlab === this.isSlabSelected) return;
    this.isSlabSelected = isSlab;
    this.takePreset();
  }

  /** Hide the options that the chosen kind of job does not have, and groups that are then empty. */
  private showKind(): void {
    const kind = this.fields.find((one) => one.name === "kind")?.value() ?? DEFAULT_KIND;
    const foreign = new Set(this.foreign[String(kind)]);
    for (const field of this.fields) field.root.hidden = foreign.has(field.name);
    for (const group of this.options.children)
      (group as HTMLElement).hidden = !group.querySelector(".option:not([hidden])");
  }

  private offer(calibrations: NamedCalibration[]): void {
    const field = this.fields.find((one) => one.name === "calibration");
    if (calibrations.length)
      field?.suggest(calibrations.map((one) => [`calibrations/${one.name}`, `${one.name}: ${one.state}`]));
  }

  private arrange(hasCaptures: boolean): void {
    const labelled = (text: string, input: HTMLElement, ...more: HTMLElement[]) =>
      element("div", { class: "option" }, element("label", { for: input.id }, text), input, ...more);
    const upload = element(
      "a",
      { href: "#/new" },
      hasCaptures ? "Upload another one" : "There is none yet; upload one",
    );
    this.capture.hidden = !hasCaptures;
    this.root.append(
      element("h2", {}, "Submit a job"),
      element(
        "section",
        {},
        element("h3", {}, "Source"),
        element(
          "div",
          { class: "options" },
          labelled("What is fitted from", this.source),
          labelled("Capture", this.capture, element("p", { class: "help" }, upload)),
        ),
      ),
      this.rigOptions,
      element(
        "section",
        {},
        element("h3", {}, "Options"),
        element(
          "div",
          { class: "options" },
          labelled("Preset", this.preset, this.summary),
          labelled(
            "Name of the job",
            this.name,
            element("p", { class: "soft help" }, "A label for people, up to 80 characters; may stay empty."),
          ),
        ),
        this.options,
      ),
      this.refusal,
      element("p", {}, this.go),
    );
    this.takePreset();
    this.showSource();
  }

  private get isDemo(): boolean {
    return this.source.value === DEMO;
  }

  private showSource(): void {
    this.rigOptions.hidden = this.source.value !== "rig";
    const place = this.capture.parentElement;
    if (place) place.hidden = this.source.value !== "capture";
  }

  /** Fill the form with the preset's options; those that the capture needs have precedence. */
  private takePreset(): void {
    const preset = this.presets.find((one) => one.name === this.preset.value);
    this.summary.textContent = preset?.summary ?? "";
    this.filledForDemo = this.isDemo;
    const options: Preset["options"] = {
      ...preset?.options,
      ...(this.isDemo ? this.demo : {}),
      ...(this.isSlabSelected ? { kind: SLAB_KIND } : {}),
    };
    for (const field of this.fields) {
      if (field.name in options) field.set(options[field.name]);
      else field.reset();
    }
    this.showKind();
  }

  private async submit(): Promise<void> {
    this.refusal.hidden = true;
    const isRig = this.source.value === "rig";
    const shownFields = [...(isRig ? this.rigFields : []), ...this.fields];
    const wrong = shownFields.filter((field) => !field.check());
    wrong[0]?.focus();
    if (wrong.length) return;
    this.go.disabled = true;
    try {
      const job = await submitJob({
        ...values(this.fields),
        ...this.origin(),
        ...(this.name.value.trim() ? { name: this.name.value.trim() } : {}),
      });
      location.hash = `#/${job.id}`;
    } catch (problem) {
      if (problem instanceof Unauthenticated) throw problem;
      this.refuse(sentenceOf(problem), shownFields);
    } finally {
      this.go.disabled = false;
    }
  }

  private origin(): object {
    if (this.isDemo) return { rig: this.demo["rig"] };
    if (this.source.value === "rig")
      return {
        rig: {
          ...Object.fromEntries(
            Object.entries(values(this.rigFields)).map(([name, value]) => [name.slice("rig.".length), value]),
          ),
          [FLASHES]: this.flashes.value(),
        },
      };
    return { capture: `captures/${this.capture.value}` };
  }

  /** Show a refusal; a sentence that begins with the name of an option is shown beside that option. */
  private refuse(sentence: string, fields: OptionField[]): void {
    const name = sentence.match(/^(?:Option )?'([\w.]+)'/)?.[1] ?? "";
    const field = fields.find((one) => one.name === name || name.startsWith(`${one.name}.`));
    if (field) {
      field.accuse(sentence);
      field.focus();
      return;
    }
    this.refusal.hidden = false;
    this.refusal.textContent = sentence;
  }
}

/** Whether a capture is one of a slab; false where the server cannot say so now, as the kind can be chosen by hand. */
async function isOfSlab(capture: string): Promise<boolean> {
  try {
    return (await getCapture(capture)).files.some((file) => file.path === SLAB_DESCRIPTION);
  } catch (problem) {
    if (problem instanceof Unauthenticated) throw problem;
    return false;
  }
}

function values(fields: OptionField[]): Record<string, unknown> {
  return Object.fromEntries(
    fields.map((field) => [field.name, field.value()]).filter(([, value]) => value !== undefined),
  );
}
