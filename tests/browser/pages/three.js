import { Color, LinearSRGBColorSpace, PerspectiveCamera, Scene, WebGPURenderer } from 'three/webgpu'
import { GaussianSplatPLYLoader } from 'three/addons/loaders/GaussianSplatPLYLoader.js'
import { GaussianSplat } from 'three/addons/objects/GaussianSplat.js'
import { canvas, pose, readPixels } from './common.js'

// `settings`: of its renderer.
export async function start(settings) {
  const renderer = new WebGPURenderer({ canvas, antialias: false, forceWebGL: true, ...settings })
  await renderer.init()
  renderer.outputColorSpace = LinearSRGBColorSpace // the colors of a file are those of a screen already
  renderer.setPixelRatio(1)
  const scene = new Scene()
  const camera = new PerspectiveCamera()
  let splats = null

  return {
    async open(url) {
      if (splats) scene.remove(splats)
      splats = new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync(url), { autoSort: false })
      splats.frustumCulled = false
      scene.add(splats)
    },

    async draw(view) {
      renderer.setSize(view.width, view.height, false)
      scene.background = new Color().setRGB(...view.background, LinearSRGBColorSpace)
      pose(camera, view)
      splats._sortInitialized = false // it sorts anew after a turn of two degrees only
      splats.updateSort(renderer, camera)
      renderer.render(scene, camera)
      renderer.render(scene, camera)
      return readPixels(renderer.backend.gl, view)
    },
  }
}
