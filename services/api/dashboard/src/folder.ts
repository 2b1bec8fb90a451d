/** The files of a folder that was chosen or dropped, by their paths in it, without those that no capture may hold. */

/**
 * Files that a capture may hold, as in the server's own list: descriptions, images and meshes, and the chunks of
 * arrays.
 */
const OF_A_CAPTURE = /\.(csv|json|jsonl|toml|npy|png|tif|tiff|exr|ply|obj|stl)$/i;
const CHUNK = /[^/]\.zarr\/(.*\/)?c(\/\d+)+$/;

export interface FolderFile {
  path: string;
  file: File;
}

export interface Folder {
  files: FolderFile[];
  /** Paths of files that are no part of a capture. */
  leftOut: string[];
}

export function chosen(list: FileList): Folder {
  return sorted(
    [...list].map((file) => ({ path: file.webkitRelativePath.split("/").slice(1).join("/") || file.name, file })),
  );
}

/**
 * Return the files that were dropped: a folder, or the files and folders in one. It must be called before the drop
 * event is over.
 */
export async function dropped(items: DataTransferItemList): Promise<Folder> {
  const entries = [...items].map((item) => item.webkitGetAsEntry()).filter((entry) => entry !== null);
  const [only] = entries;
  const tops = entries.length === 1 && only?.isDirectory ? await children(only as FileSystemDirectoryEntry) : entries;
  return sorted((await Promise.all(tops.map((entry) => walk(entry, "")))).flat());
}

function sorted(all: FolderFile[]): Folder {
  const isPart = ({ path }: FolderFile) =>
    !path.split("/").some((part) => part.startsWith(".")) && (OF_A_CAPTURE.test(path) || CHUNK.test(path));
  const files = all.filter(isPart).sort((a, b) => (a.path < b.path ? -1 : 1));
  return { files, leftOut: all.filter((one) => !isPart(one)).map(({ path }) => path) };
}

async function walk(entry: FileSystemEntry, above: string): Promise<FolderFile[]> {
  const path = above + entry.name;
  if (entry.isDirectory)
    return (
      await Promise.all((await children(entry as FileSystemDirectoryEntry)).map((one) => walk(one, `${path}/`)))
    ).flat();
  return [{ path, file: await new Promise<File>((done, fail) => (entry as FileSystemFileEntry).file(done, fail)) }];
}

/** List the entries of a folder; a reader returns a hundred of them at a time. */
async function children(folder: FileSystemDirectoryEntry): Promise<FileSystemEntry[]> {
  const reader = folder.createReader();
  const all: FileSystemEntry[] = [];
  for (;;) {
    const some = await new Promise<FileSystemEntry[]>((done, fail) => reader.readEntries(done, fail));
    if (!some.length) return all;
    all.push(...some);
  }
}
