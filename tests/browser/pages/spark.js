import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark'
import * as THREE from 'three'
import { canvas, drawUntil, pose, readPixels } from './common.js'

// `settings`: SparkRenderer's options; its defaults are what its users see.
export async function start(settings) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false })
  renderer.setPixelRatio(1)
  const scene = new THREE.Scene()
  const camera = new THREE.PerspectiveCamera()
  const spark = new SparkRenderer({ renderer, ...settings })
  scene.add(spark)
  let splats = null

  return {
    async open(url) {
      if (splats) {
        scene.remove(splats)
        splats.dispose()
      }
      splats = new SplatMesh({ url })
      await splats.initialized
      scene.add(splats)
    },

    async draw(view) {
      renderer.setSize(view.width, view.height, false)
      renderer.setClearColor(new THREE.Color(...view.background), 1)
      pose(camera, view)
      await spark.update({ scene, camera })
      await drawUntil(
        () => !spark.sorting && !spark.sortDirty && spark.display === spark.current,
        () => renderer.render(scene, camera),
      )
      return readPixels(renderer.getContext(), view)
    },
  }
}
