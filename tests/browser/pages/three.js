import { Color, LinearSRGBColorSpace, PerspectiveCamera, Scene, WebGPURenderer } from 'three/webgpu'
import { GLTFGaussianSplatLoaderExtension } from 'three/addons/loaders/GLTFGaussianSplatLoaderExtension.js'
import { GLTFLoader } from 'three/addons/loaders/GLTFLoader.js'
import { GaussianSplatPLYLoader } from 'three/addons/loaders/GaussianSplatPLYLoader.js'
import { SPZLoader } from 'three/addons/loaders/SPZLoader.js'
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
      splats = url.endsWith('.glb') ? await splatsOfGltf(url) : new GaussianSplat(await loaderOf(url).loadAsync(url))
      splats.autoSort = false
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

const loaderOf = (url) => (url.endsWith('.spz') ? new SPZLoader() : new GaussianSplatPLYLoader())

async function splatsOfGltf(url) {
  const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser))
  const { scene } = await loader.loadAsync(url)
  return scene.getObjectByProperty('isGaussianSplat', true)
}
