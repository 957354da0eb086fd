// SPDX-License-Identifier: GPL-3.0-or-later
// A job type for Flamenco 3: Neural GASh bakes, spread over the farm. See docs/farm.md.

const JOB_TYPE = {
    label: "Neural GASh Bake",
    description: "Bake precomputed radiance transfer of objects, at one frame or at many",
    settings: [
        { key: "blendfile", type: "string", required: true, visible: "web",
          description: "The file that is baked" },
        { key: "objects", type: "string", required: true,
          eval: "'|'.join(o.name for o in C.selected_objects if o.type == 'MESH')",
          description: "Names of the objects, with | between them; each is baked by itself" },
        { key: "frames", type: "string", default: "",
          description: "Such as 1-10 or 1-10,20; empty: as the file was saved" },
        { key: "output", type: "string", subtype: "dir_path", required: true,
          description: "Folder for the .npz files, which every worker can write to" },
        { key: "tolerance", type: "float", default: 0.02, description: "Relative L2 error to reach" },
        { key: "order", type: "int32", default: 3, description: "Bands of spherical harmonics, 2 to 5" },
        { key: "occluders", type: "string", default: "self",
          description: "What casts shadows: self, visible, or the name of a collection" },
        { key: "tasks", type: "int32", default: 8, description: "How many tasks the bakes are spread over" },
    ],
};

function compileJob(job) {
    const settings = job.settings;
    const objects = settings.objects.split("|").filter((name) => name !== "");
    if (!objects.length) throw new Error("Name the objects to bake.");
    if (settings.tasks < 1) throw new Error("There must be one task or more.");

    // Option and value in one, as names may begin with a dash.
    const args = ["--command", "neural_gash", "bake", settings.blendfile];
    for (const name of objects) args.push(`--object=${name}`);
    if (settings.frames) args.push(`--frames=${settings.frames}`);
    args.push(`--tolerance=${settings.tolerance}`, `--order=${settings.order}`, `--occluders=${settings.occluders}`);
    const name = settings.frames ? "{file}-{object}-{frame}.npz" : "{file}-{object}.npz";
    args.push(`--npz=${settings.output.replace(/[\\/]+$/, "")}/${name}`);

    for (let i = 1; i <= settings.tasks; i++) {
        const task = author.Task(`bake-${i}-of-${settings.tasks}`, "blender");
        task.addCommand(author.Command("exec", {
            exe: "{blender}",
            args: args.concat([`--shard=${i}/${settings.tasks}`]),
        }));
        job.addTask(task);
    }
}
