from kgs.datasets import synthetic_scene
from kgs.fit import FitConfig, Trainer, choose_points, make_plan, measure, prune

scene = synthetic_scene(train_views=3, size=(36, 48))
config = FitConfig(steps=20)
points = choose_points(scene, config)  # those of `kgs fit`
plan = make_plan(scene, config, points)  # settles what the configuration leaves open
trainer = Trainer(scene, plan, points)
while trainer.step < plan.schedule.steps:
    loss = trainer.train_step()  # with densification and the recipe of `kgs fit`
fit = prune(trainer.result())  # a Fit, the same as `fit_scene(scene, config)`

image = fit.render(scene.test.camera(0))  # (1, 3, H, W), all Gaussians
curve = fit.history["curve"]  # step, seconds, test_psnr, train_psnr
metrics = measure(fit)  # the content of metrics.json
