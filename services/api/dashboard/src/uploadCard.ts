/**
 * A place for a folder with a capture: the folder is dropped or chosen, and uploaded with a progress bar. An upload
 * that was interrupted goes on when the same folder is given again.
 */

import { sentenceOf, Unauthenticated } from "./api";
import { element } from "./element";
import { chosen, dropped, type Folder } from "./folder";
import { FolderUpload, type UploadedCapture, type UploadProgress } from "./folderUpload";
import { bytes } from "./format";

const LEFT_OUT_SHOWN = 3;

export class UploadCard {
  private readonly picker = element("input", {
    id: "folder",
    type: "file",
    webkitdirectory: "",
    class: "hidden-input",
  });
  private readonly zone = element(
    "div",
    { class: "drop" },
    element("p", {}, "Drop the folder here, or"),
    element("label", { for: "folder", class: "button primary" }, "Choose a folder"),
    this.picker,
  );
  private readonly bar = element("progress", { max: "1", value: "0", "aria-label": "Upload" });
  private readonly note = element("p", { role: "status" });
  private readonly leftOut = element("p", { class: "soft" });
  private readonly refusal = element("p", { class: "failure", role: "alert" });
  readonly root = element("div", { class: "upload" }, this.zone, this.bar, this.note, this.leftOut, this.refusal);
  private isBusy = false;

  constructor(private readonly onDone: (capture: UploadedCapture) => void) {
    for (const one of [this.bar, this.note, this.leftOut, this.refusal]) one.hidden = true;
    this.picker.addEventListener("change", () => {
      if (this.picker.files?.length) void this.upload(Promise.resolve(chosen(this.picker.files)));
      this.picker.value = ""; // so that the same folder can be chosen again
    });
    this.zone.addEventListener("dragover", (event) => {
      event.preventDefault();
      this.zone.classList.add("over");
    });
    this.zone.addEventListener("dragleave", () => this.zone.classList.remove("over"));
    this.zone.addEventListener("drop", (event) => {
      event.preventDefault();
      this.zone.classList.remove("over");
      if (event.dataTransfer) void this.upload(dropped(event.dataTransfer.items));
    });
    window.addEventListener("beforeunload", (event) => {
      if (this.isBusy) event.preventDefault(); // the browser then asks whether to leave the page
    });
  }

  private async upload(given: Promise<Folder>): Promise<void> {
    if (this.isBusy) return;
    this.isBusy = true;
    this.zone.hidden = true;
    this.refusal.hidden = true;
    try {
      const folder = await given;
      this.show(folder);
      const capture = await new FolderUpload(folder.files, (progress) => this.showProgress(progress)).run();
      this.note.textContent = "Uploaded and checked.";
      this.onDone(capture);
    } catch (problem) {
      this.refusal.hidden = false;
      this.refusal.textContent = `${sentenceOf(problem)} What was sent is kept: choose the same folder again to go on.`;
      if (problem instanceof Unauthenticated) throw problem;
    } finally {
      this.isBusy = false;
      this.zone.hidden = false;
      this.bar.hidden = true;
    }
  }

  private show({ files, leftOut }: Folder): void {
    if (!files.length)
      throw new Error("The folder holds no file of a capture; choose the one with capture.json, raw.toml or slab.json.");
    this.bar.hidden = false;
    this.note.hidden = false;
    this.leftOut.hidden = leftOut.length === 0;
    const more = leftOut.length > LEFT_OUT_SHOWN ? ` and ${leftOut.length - LEFT_OUT_SHOWN} more` : "";
    const shown = leftOut.slice(0, LEFT_OUT_SHOWN).join(", ");
    this.leftOut.textContent = `Left out, as no part of a capture: ${shown}${more}.`;
  }

  private showProgress({ phase, path, doneBytes, totalBytes }: UploadProgress): void {
    this.bar.value = totalBytes ? doneBytes / totalBytes : 0;
    const doing = phase === "hashing" ? "Reading" : "Sending";
    this.note.textContent = `${doing} ${path}: ${bytes(doneBytes)} of ${bytes(totalBytes)}.`;
  }
}
