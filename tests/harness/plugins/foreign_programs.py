"""Stand-ins for programs of others, in any Python: their command lines, and the files that they
read and write, as their documentation and sources have them. They show training photos.
"""

import argparse
import json
import os
import re
import shutil
import sys


def options(words, *names, flags=()):
    """Parse a command line that must have exactly these options."""
    parser = argparse.ArgumentParser(allow_abbrev=False)
    for name in names:
        parser.add_argument(name, **({"required": True} if name.startswith("-") else {}))
    for flag in flags:
        parser.add_argument(flag, action="store_true", required=True)
    return vars(parser.parse_args(words))


def cloud(path):
    os.makedirs(os.path.dirname(path), exist_ok=True)
    with open(path, "w") as file:
        file.write("ply\nformat ascii 1.0\nelement vertex 12\nproperty float x\n")
        file.write("property float y\nproperty float z\nend_header\n")


def show(source, target):
    os.makedirs(os.path.dirname(target), exist_ok=True)
    shutil.copy(source, target)


def ns_train(words):
    given = options(
        words,
        *("method", "--output-dir", "--experiment-name", "--timestamp", "--max-num-iterations"),
        *("--machine.seed", "--vis", "dataparser", "--data", "--load-3D-points"),
    )
    assert (given["method"], given["dataparser"]) == ("splatfacto", "nerfstudio-data")
    assert given["vis"] == "tensorboard" and given["load_3D_points"] == "True"
    folder = os.path.join(
        given["output_dir"], given["experiment_name"], "splatfacto", given["timestamp"]
    )
    os.makedirs(os.path.join(folder, "nerfstudio_models"))
    with open(os.path.join(folder, "config.yml"), "w") as file:
        file.write(given["data"])


def ns_render(words):
    given = options(
        words,
        *("what", "--load-config", "--output-path", "--split", "--rendered-output-names"),
        "--image-format",
    )
    with open(given["load_config"]) as file:
        data = file.read()
    with open(os.path.join(data, "transforms.json")) as file:
        scene = json.load(file)
    assert os.path.isfile(os.path.join(data, scene["ply_file_path"]))
    assert (given["what"], given["split"], given["image_format"]) == ("dataset", "test", "png")
    for name in scene["test_filenames"]:
        place = os.path.join("test", given["rendered_output_names"], os.path.basename(name))
        photo = os.path.join(data, scene["train_filenames"][0])
        show(photo, os.path.join(given["output_path"], place))


def ns_export(words):
    given = options(words, "what", "--output-dir", "--load-config")
    assert given["what"] == "gaussian-splat" and os.path.isfile(given["load_config"])
    cloud(os.path.join(given["output_dir"], "splat.ply"))


def chronogs_train(words):
    given = options(words, "--config", "--source_path", "--model_path")
    with open(given["config"]) as file:
        text = file.read()
    iterations = re.search(r"\biterations: (\d+)", text)[1]
    assert f"max_steps: {iterations}" in text and f"until: {int(iterations) // 2}" in text
    cloud(os.path.join(given["model_path"], f"point_cloud/iteration_{iterations}/point_cloud.ply"))


def chronogs_render(words):
    given = options(words, "-m", "-s", flags=["--skip_train"])
    with open(os.path.join(given["s"], "sparse/split.txt")) as file:
        # Its parser cuts at single blanks, and names at their first dot.
        periods = {
            line.strip().split(" ")[0].split(".")[0]: line.strip().split(" ")[1] for line in file
        }
    with open(os.path.join(given["s"], "sparse/0/test.txt")) as file:
        tests = sorted(line.strip().split(".")[0] for line in file)
    (last,) = os.listdir(os.path.join(given["m"], "point_cloud"))
    for i, test in enumerate(tests):
        like = min(n for n in periods if n not in tests and periods[n] == periods[test])
        place = f"test/ours_{last.split('_')[-1]}/renders/{i:05d}.png"
        show(os.path.join(given["s"], "images", f"{like}.png"), os.path.join(given["m"], place))


def four_d_train(words):
    given = options(words, "-s", "--model_path", "--configs", "--save_iterations")
    config = {}
    with open(given["configs"]) as file:
        exec(file.read(), config)
    assert os.path.isfile(config["_base_"][0])
    assert config["OptimizationParams"]["iterations"] == int(given["save_iterations"])
    # Its pictures of the training are labelled in a font that it seeks in the working folder.
    assert config["ModelParams"]["render_process"] is False
    with open(os.path.join(given["s"], "points3D_downsample2.ply"), "rb") as file:
        assert b"property float nx" in file.read(400)
    assert not os.path.exists(os.path.join(given["s"], "sparse")), "it would be read as COLMAP"
    last = f"point_cloud/iteration_{given['save_iterations']}"
    cloud(os.path.join(given["model_path"], last, "point_cloud.ply"))
    cloud(os.path.join(given["model_path"], last, "deformation.pth"))
    with open(os.path.join(given["model_path"], "cfg_args"), "w") as file:
        file.write(given["s"])


def four_d_render(words):
    given = options(words, "--model_path", "--configs", flags=["--skip_train", "--skip_video"])
    with open(os.path.join(given["model_path"], "cfg_args")) as file:
        data = file.read()
    read = {}
    for name in ("dataset", "metadata", "scene"):
        with open(os.path.join(data, f"{name}.json")) as file:
            read[name] = json.load(file)
    times = {name: keys["warp_id"] for name, keys in read["metadata"].items()}
    last = max(times.values())  # by which all are divided
    tests = [name for name in read["dataset"]["ids"] if name in read["dataset"]["val_ids"]]
    (saved,) = os.listdir(os.path.join(given["model_path"], "point_cloud"))
    for i, test in enumerate(tests):
        train = read["dataset"]["train_ids"]
        like = min(name for name in train if times[name] / last == times[test] / last)
        place = f"test/ours_{saved.split('_')[-1]}/renders/{i:05d}.png"
        photo = os.path.join(data, f"rgb/2x/{like}.png")
        show(photo, os.path.join(given["model_path"], place))


def clnerf_train(words):
    given = options(
        words,
        *("--root_dir", "--dataset_name", "--exp_name", "--num_epochs", "--batch_size", "--lr"),
        *("--rep_size", "--task_curr", "--task_number", "--dim_a", "--scale", "--downsample"),
        "--vocab_size",
    )
    images = os.path.join(given["root_dir"], "images")
    assert os.path.isfile(os.path.join(given["root_dir"], "sparse/0/cameras.bin"))
    tasks = sorted(os.listdir(images))
    last, task = len(tasks) - 1, int(given["task_curr"])
    assert given["task_number"] == given["vocab_size"] == str(len(tasks))
    run = f"{given['dataset_name']}/{given['exp_name']}"
    results = f"results/NGPGv2/CLNerf/{run}"
    assert os.path.isfile(f"{results}/rep/rep_buf.torchSave") == (task > 0)
    os.makedirs(f"{results}/rep", exist_ok=True)
    open(f"{results}/rep/rep_buf.torchSave", "w").close()
    weights = f"ckpts/NGPGv2_CL/{run}/epoch={int(given['num_epochs']) - 1}.ckpt"
    os.makedirs(os.path.dirname(weights), exist_ok=True)
    with open(weights, "x") as file:
        file.write(f"task {task}")
    index = 0
    for name in tasks if task == last else ():
        names = sorted(os.listdir(os.path.join(images, name)))
        for _ in names[::8]:
            like = next(n for i, n in enumerate(names) if i % 8)
            show(os.path.join(images, name, like), f"{results}/{index:03d}.png")
            index += 1


if __name__ == "__main__":
    globals()[sys.argv[1]](sys.argv[2:])
