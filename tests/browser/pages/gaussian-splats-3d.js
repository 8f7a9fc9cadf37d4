import { LogLevel, RenderMode, SceneRevealMode, Viewer } from '@mkkellogg/gaussian-splats-3d'
import * as THREE from 'three'
import { canvas, pose, readPixels } from './common.js'

// `settings`: the Viewer's options; its defaults are what its users see.
export async function start(settings) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false })
  renderer.setPixelRatio(1)
  const camera = new THREE.PerspectiveCamera()
  let viewer = null

  return {
    async open(url) {
      if (viewer) await viewer.dispose()
      viewer = new Viewer({
        renderer,
        camera,
        selfDrivenMode: false,
        useBuiltInControls: false,
        sharedMemoryForWorkers: false, // it asks for headers that this server does not send
        sceneRevealMode: SceneRevealMode.Instant, // the fading in is over
        renderMode: RenderMode.Always,
        ...settings,
      })
      await viewer.addSplatScene(url, { showLoadingUI: false, progressiveLoad: false })
    },

    async draw(view) {
      renderer.setSize(view.width, view.height, false)
      renderer.setClearColor(new THREE.Color(...view.background), 1)
      pose(camera, view)
      // After a large turn it sorts the nearest eighth, third, three quarters, then all, one at a time: the fifth is of all.
      for (let i = 0; i < 5; i++) {
        await viewer.sortPromise
        await viewer.runSplatSort(true, true)
      }
      await viewer.sortPromise
      viewer.update()
      viewer.render()
      return readPixels(renderer.getContext(), view)
    },
  }
}
