import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark'
import * as THREE from 'three'
import { canvas, drawUntil, nextFrame, pose, readPixels } from './common.js'

// A ladder in Spark, by the module that is written with its levels.
export async function start() {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false })
  renderer.setPixelRatio(1)
  const scene = new THREE.Scene()
  const camera = new THREE.PerspectiveCamera()
  const spark = new SparkRenderer({ renderer })
  scene.add(spark)
  let levels = null

  return {
    async open(url) {
      if (levels) scene.remove(levels)
      const { Levels } = await import(url)
      levels = await Levels.load(async (file) => {
        const splats = new SplatMesh({ url: file })
        await splats.initialized
        return splats
      })
      scene.add(levels)
    },

    async draw(view) {
      renderer.setSize(view.width, view.height, false)
      renderer.setClearColor(new THREE.Color(...view.background), 1)
      pose(camera, view)
      do {
        levels.update(camera, renderer)
        await nextFrame()
      } while (levels.shown !== levels.wanted)
      await spark.update({ scene, camera })
      await drawUntil(
        () => !spark.sorting && !spark.sortDirty && spark.display === spark.current,
        () => renderer.render(scene, camera),
      )
      return readPixels(renderer.getContext(), view)
    },

    // The level that the last picture shows, and at which zoom.
    shown: () => [levels.shown, levels.zoom(camera, renderer)],

    // Puts the ladder elsewhere, turned and enlarged, as pages do with what they show.
    place(position, quaternion, scale) {
      levels.position.set(...position)
      levels.quaternion.set(...quaternion)
      levels.scale.setScalar(scale)
    },
  }
}
